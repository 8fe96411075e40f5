"""Self-contained HTML pages: frame, common style, and embedding of files and data."""

from __future__ import annotations

import base64
import html
import json
from typing import Any

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 84rem; color: #222;
       padding: 0 1rem; }
table { border-collapse: collapse; margin: 0.7rem 0; display: block; overflow-x: auto; }
th, td { padding: 0.2rem 0.5rem; font-size: 14px; border-bottom: 1px solid #ddd; text-align: left;
         white-space: nowrap; }
th { border-bottom: 2px solid #888; }
td small { color: #777; }
img { max-width: 100%; }
figure { display: inline-block; margin: 0.4rem; vertical-align: top; }
figcaption { font-size: 13px; max-width: 320px; }
.note { color: #555; font-size: 14px; }
"""
_POLICY = "default-src 'none'; img-src data:; media-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"  # noqa: E501


def make_head(title: str, style: str = "") -> str:
    """Begin a page, up to `<body>`; its content security policy forbids external requests."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
        '<meta name="viewport" content="width=device-width">'
        f"<title>{escape(title)}</title><style>{STYLE}{style}</style></head>\n<body>\n"
    )


FOOT = "\n</body></html>\n"
"""End of a page."""


def escape(text: object) -> str:
    """Escape a text for HTML."""
    return html.escape(str(text))


def embed(content: bytes, kind: str) -> str:
    """Return a data URL of a file; `kind` is its media type, such as `image/png`."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def dump_script(value: Any) -> str:
    """Write plain values as JSON that is safe in a `<script>`."""
    text = json.dumps(value, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    # Nothing in it may end the script; in JSON, `<` occurs only in strings, where it is escaped.
    return text.replace("<", "\\u003c").replace("\u2028", "\\u2028").replace("\u2029", "\\u2029")
