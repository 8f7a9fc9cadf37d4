"""A stand-in for splat-transform as it is used for what viewers stream."""

# Of a lod-meta.json it writes its arguments, two chunks, and for each level a SOG in two halves, with opacities and no more: the splats in reverse,
# twice the first one where a file says that it does so. It fails for a file that says that it is broken, or has SH degree 4. Of an SPZ it writes 60
# splats of degree 1.
STAND_IN = """import gzip, json, pathlib, struct
import numpy as np
from PIL import Image
if sys.argv[1:] == ["--version"]:
    sys.exit(print("3.7.0"))
*words, target = sys.argv[1:]
target = pathlib.Path(target)
contents = [pathlib.Path(word).read_bytes() for word in words if word.endswith(".ply")]
if any(b"comment broken" in content or b" f_rest_45" in content for content in contents):
    sys.exit("    ✗ Error: EFBIG: file too large, write\\n    at async write (node:internal/fs)\\n\\n✗ failed in 0.909s  [peak cpu=248.4MB]")
if target.suffix == ".spz":
    sys.exit(target.write_bytes(gzip.compress(struct.pack("<IIIBBBB", 0x5053474E, 3, 60, 1, 12, 0, 0) + bytes(60 * 29))) and None)
files = []
for level, content in enumerate(contents):
    header, _, body = content.partition(b"end_header\\n")
    names = [line.split()[2] for line in header.splitlines() if line.startswith(b"property float ")]
    values = np.frombuffer(body, "<f4").reshape(-1, len(names))[::-1, names.index(b"opacity")]
    values = np.append(values[:-1], values[0]) if b"comment twice" in header else values
    for half, own in enumerate(np.array_split(values, 2)):
        files.append(f"{level}_{half}/meta.json")
        folder = (target.parent / files[-1]).parent
        folder.mkdir()
        pixels = np.zeros((1, len(own), 4), np.uint8)
        pixels[..., 3] = 255 / (1 + np.exp(-own.astype(np.float64)))
        Image.fromarray(pixels, "RGBA").save(folder / "sh0.webp", lossless=True, exact=True)
        (folder / "meta.json").write_text(json.dumps({"version": 2, "count": len(own), "model": "antialiased", "sh0": {"files": ["sh0.webp"]}}))
lods = lambda half, counts: {str(level): {"file": 2 * level + half, "count": count} for level, count in enumerate(counts)}
leaf = lambda x, lods: {"bound": {"min": [x, 0, 0], "max": [x + 2, 1, 1]}, "lods": lods}
leaves = [leaf(0, lods(0, [30, 2, 1][: len(contents)])), leaf(2, lods(1, [10, 3, 1][: len(contents)]))]
text = json.dumps({"asked": words, "lodLevels": len(contents), "filenames": files, "tree": {"children": leaves}})
target.write_text(text)
"""
