"""`python -m mipmap_plugin`: the command, where it is not on the path."""

import sys

from mipmap_plugin.cli import main

sys.exit(main())
