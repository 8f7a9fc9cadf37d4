"""The process of a command: what `mipmap-plugin` and `python -m mipmap_plugin` run."""

import signal
import sys
import time


def run() -> int:
    """Run the command of this process, and return the exit code."""
    began = time.monotonic()
    try:
        from mipmap_plugin import progress
        from mipmap_plugin.cli import main  # which takes a moment, in which Ctrl-C may be pressed

        progress.silent_since(began)
        return main()
    except KeyboardInterrupt:  # before the command began, or after it ended
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        sys.stderr.write("mipmap-plugin: interrupted\n")
        return 130
    except Exception:
        from mipmap_plugin.registry import unreadable_package

        if not (reason := unreadable_package()):
            raise
        sys.stderr.write(f"mipmap-plugin: {reason}\n")
        return 2
    finally:  # Ctrl-C would only break off what removes temporary files, and Python would tell of that
        signal.signal(signal.SIGINT, signal.SIG_IGN)


if __name__ == "__main__":
    sys.exit(run())
