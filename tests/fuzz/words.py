"""The command line's words, sound ones and others, all from a seed; and the folder that they speak of."""

import os
import random
from pathlib import Path

import tiny
from corpus import SAMPLES

# Commands that end soon: of a tiny scene, by the reference, in one step or none.
SOUND = [
    "inspect base.ply --json",
    "inspect model --screen-filter mip",
    "adapt base.ply --scale 1/2 --recipe instant --backend reference --output out.ply",
    "adapt model --scale 1/2 --scale 2 --recipe instant --backend reference --output out --json",
    "adapt model --scale 1/2 --steps 1 --views given --backend reference --output new --seed 3 --background white --target-db 30",
    "adapt anchors --scale 1/2 --cameras model --recipe instant --backend reference --output out",
    "adapt moving --scale 1/2 --cameras model --recipe instant --backend reference --output out --resize area",
    "adapt base.ply model --scale 1/2 --recipe instant --backend reference --output out --shard 1/2 --report",
    "adapt base.ply --scale 1/2 --viewer spark --viewer supersplat --splats 8 --cameras model --recipe instant --backend reference",
    "adapt base.ply --scale 1/2 --tiles 2 --cameras model --recipe instant --backend reference --output out.ply",
    "levels base.ply --viewer spark --coarsest 1/2 --by zoom --cameras model --recipe instant --backend reference --output out",
    "adapt base.ply --scale 2 --steps 1 --cameras scene --upsampler bicubic --images scene --backend reference --output out.ply",
    "render model --output pictures --view view_0 --scale 1/2 --supersampling 2 --screen-filter scaled --backend reference --depth",
    "evaluate model --images scene --scale 1/2 --backend reference --output rows.json --protocol P1 --lpips-weights weights",
    "tradeoff base.ply --scale 1/2 --output measured --backend gpu",
    "backends --json",
]

NUMBERS = ["0", "-1", "nan", "inf", "1e5", "1e308", "1e-50", "1/0", "1/4", "2", "8", "1.5", "18446744073709551616"]
PATHS = [
    *("base.ply", "soft.ply", "hard.ply", "model", "model/cfg_args", "model/cameras.json", "model/point_cloud", "anchors", "moving", "scene"),
    *("scene/test/view_0.png", "/dev/null", "/dev/zero", "pipe", "loop", "dangling", "nothing/at/all", "base.ply/below", ".", "..", "full", "text"),
    *("out.ply", "new.ply", "out", "anchors/point_cloud/iteration_30000/new.ply", "z" * 250, "z" * 5000 + ".ply", "a\0b"),
]
OTHERS = ["", "x", "é" * 300, "\x1b[2J", "white", "classic", "instant", "paper", "P3", "cpu", "reference", "view_1"]
FLAGS = ["--json", "--overwrite", "--depth", "--normals", "--exposure", "--filter-3d", "--what"]

# Words without which a command takes minutes, as it should.
KEPT = {"--steps", "--recipe", "instant", "--backend", "reference", "gpu", "1"}


def prepare(folder: Path) -> None:
    """Everything that the words name."""
    tiny.ply(folder / "base.ply", count=12)
    tiny.folder(folder / "model", tiny.cameras(2, width=8, height=6), count=12)
    SAMPLES["checkpoints.pth"].make(folder / "anchors")
    SAMPLES["deform.pth"].make(folder / "moving")
    tiny.scene(folder / "scene", test=tiny.cameras(1, split="test", width=8, height=6), train=tiny.cameras(2, width=8, height=6), count=12)
    (folder / "soft.ply").symlink_to("base.ply")
    os.link(folder / "base.ply", folder / "hard.ply")
    (folder / "loop").symlink_to("loop")
    (folder / "dangling").symlink_to("nothing at all")
    os.mkfifo(folder / "pipe")
    (folder / "full").mkdir()
    (folder / "full/precious").write_text("precious")
    (folder / "text").write_text("text")


def instead(word: str, rng: random.Random) -> str:
    """Another word, as a rule of the same kind."""
    kinds = [kind for kind in (NUMBERS, PATHS, OTHERS, FLAGS) if word in kind or (kind is NUMBERS and word[:1].isdigit())]
    return rng.choice((kinds or [PATHS])[0] if rng.random() < 0.8 else rng.choice([NUMBERS, PATHS, OTHERS, FLAGS]))


def words(rng: random.Random) -> list[str]:
    """A sound command, of which up to three words are others, doubled or missing."""
    chosen = rng.choice(SOUND).split()
    for _ in range(rng.choice([1, 1, 2, 3])):
        at = rng.randrange(1, len(chosen) + 1)
        kept = at < len(chosen) and (chosen[at] in KEPT or chosen[at - 1] in KEPT)
        kind = rng.randrange(4)
        if kind == 0 and at < len(chosen) and not kept:
            chosen.pop(at)
        elif kind == 1:
            chosen.insert(at, rng.choice(FLAGS if rng.random() < 0.8 else PATHS))
        elif at < len(chosen) and not kept and (not chosen[at].startswith("--") or rng.random() < 0.1):
            chosen[at] = instead(chosen[at], rng)
    return chosen
