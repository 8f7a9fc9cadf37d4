"""What a report page holds."""

import base64
import io
import json
import re
from pathlib import Path

from PIL import Image


def record_of(page: Path) -> dict:
    """The JSON within a page."""
    return json.loads(re.search(r'<script type="application/json" id="record">(.*?)</script>', page.read_text(), re.DOTALL)[1])


def pixels(uri: str) -> Image.Image:
    """The picture of a data URI."""
    head, data = uri.split(",")
    assert head == "data:image/png;base64"
    return Image.open(io.BytesIO(base64.b64decode(data)))
