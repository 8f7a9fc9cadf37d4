"""Files that people give in place of a checkpoint, and what is said of them."""

PHOTOGRAPHS = (".jpg", ".jpeg", ".png")

# Files of splats that are not read, each of which has a sentence of its own.
UNREAD = (".lcc", ".lcc2", ".ssproj", ".psht", ".rad")

# What else people give, by its suffix: what it is, and what to do.
OTHERS = {
    **dict.fromkeys((*PHOTOGRAPHS, ".mp4", ".mov"), "a photograph or a video, not a trained scene; train one on it first, and give that"),
    **dict.fromkeys((".obj", ".fbx", ".stl", ".las", ".laz"), "a mesh or a plain point cloud, not Gaussian splats; give a trained model"),
    **dict.fromkeys((".usd", ".usda", ".usdc", ".usdz"), "USD, which is not read here; export a PLY from the program that made it"),
    ".ssproj": "a project of SuperSplat, which moves and tints its splats; open it there and export a PLY",
    ".psht": "a project of Postshot; open it there and export a PLY",
    ".rad": "RAD of Spark, which is not read here; give the file that it was made from",
    ".npz": "a NumPy archive that no family knows; give a PLY file, which npz2ply.py of c3dgs makes of its own, or register its family",
    ".hier": "a hierarchy of Hierarchical 3D Gaussians, whose splats follow the distance, which is not read here; "
    "give the PLY of one of its chunks (trained_chunks/<name>/point_cloud/iteration_<N>)",
}
