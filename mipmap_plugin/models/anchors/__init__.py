"""Models of anchors: Scaffold-GS and Octree-GS."""
