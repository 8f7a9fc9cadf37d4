"""The files beside an anchor PLY that hold its networks. It imports no torch, so that a checkpoint is recognized without."""

from __future__ import annotations

from pathlib import Path

# The files of a split checkpoint; those of NEEDED are required.
FILES = {
    "opacity_mlp": "opacity_mlp.pt", "cov_mlp": "cov_mlp.pt", "color_mlp": "color_mlp.pt",
    "feature_bank_mlp": "feature_bank_mlp.pt", "appearance": "embedding_appearance.pt",
}  # fmt: skip
NEEDED = ("opacity_mlp", "cov_mlp", "color_mlp")

# One file with all networks, the original's other format.
UNITED = "checkpoints.pth"


def missing_networks(folder: Path) -> list[str]:
    """The required network files that are missing in `folder`."""
    return [] if (folder / UNITED).is_file() else [FILES[name] for name in NEEDED if not (folder / FILES[name]).is_file()]
