"""The node that speaks OpenIGTLink with 3D Slicer; only `messages` needs the package pyigtl."""
