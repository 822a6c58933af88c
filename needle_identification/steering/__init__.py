"""How a needle bends in tissue, from its depth, its guide, its roll and its tip."""
