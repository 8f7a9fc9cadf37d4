"""Zip archives of files and of model folders."""

import zipfile


def archive(path, files):
    """A zip archive of files, by their names in it."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in files.items():
            opened.writestr(name, content)
    return path


def packed(path, folder, top="my model", beside=None):
    """A zip archive of a model folder, which is called `top` in it."""
    files = {f"{top}/{file.relative_to(folder)}" if top else str(file.relative_to(folder)): file for file in folder.rglob("*") if file.is_file()}
    return archive(path, {name: file.read_bytes() for name, file in files.items()} | (beside or {}))
