"""A checkpoint of 2D Gaussian Splatting as its project leaves it."""

import ply_files
import tiny

from mipmap_plugin.models.columns import to_columns
from mipmap_plugin.scenes import write_cameras


def columns(count=50):
    """Raw columns as 2DGS writes them: those of 3DGS without scale_2."""
    return {name: column for name, column in to_columns(tiny.model(count).parameters()).items() if name != "scale_2"}


def folder(path):
    ply = path / "point_cloud" / "iteration_30000" / "point_cloud.ply"
    ply.parent.mkdir(parents=True)
    ply_files.write(ply, columns())
    (path / "cfg_args").write_text("Namespace(sh_degree=1, resolution=1, white_background=False, eval=False, render_items=['RGB', 'Alpha'])")
    write_cameras(path / "cameras.json", tiny.cameras())
    return path
