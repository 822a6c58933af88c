"""
Environments for reinforcement learning: `NeedleInsertion-v0` and `NeedleSteering-v0`.

They are registered with Gymnasium where this package is installed (extra ``gym``).
"""

from __future__ import annotations


def register() -> None:
    """Tell Gymnasium of the environments; it calls this itself."""
    import gymnasium

    for name, steps in (('NeedleInsertion', 500), ('NeedleSteering', 100)):
        environment = name.removeprefix('Needle')
        gymnasium.register(
            f'{name}-v0',
            f'needle_insertion.gym.{environment.lower()}:{environment}Env',
            vector_entry_point=(
                'needle_insertion.gym.insertion:InsertionVectorEnv'
                if environment == 'Insertion'
                else None
            ),
            max_episode_steps=steps,
        )
