"""One exception tree: every error a user can cause is a `MipmapPluginError` whose text says what, where and what to do."""


# Letters of a sentence at most. A damaged file that is quoted may have megabytes in place of a name or a number.
LONGEST = 1500


class MipmapPluginError(Exception):
    """Base of all errors that the command line turns into one sentence and exit code 2. Of a long one, its beginning and its end are told."""

    def __str__(self) -> str:
        text = super().__str__()
        return text if len(text) <= LONGEST else f"{text[: 2 * LONGEST // 3]} ... {text[-LONGEST // 4 :]}"


class CheckpointError(MipmapPluginError, ValueError):
    """A checkpoint that cannot be read, or not in the way that was asked."""


class SceneError(MipmapPluginError, ValueError):
    """Cameras or images that cannot be read."""


class ShapeError(MipmapPluginError, ValueError):
    """Tensors that do not fit together."""


class SettingsError(MipmapPluginError, ValueError):
    """A request that cannot be served as it was put."""


class BackendUnavailable(MipmapPluginError, ImportError):
    """No backend can serve a request; the text holds each backend's reasons."""


class PluginError(MipmapPluginError, ImportError):
    """A registered name whose target does not import or does not fit."""


class OutputError(MipmapPluginError, OSError):
    """An output that the system refuses to write: a full disk, a missing permission."""


class OutputExists(MipmapPluginError, FileExistsError):
    """An output that is already there and was not to be overwritten."""
