"""The sign-in page: one form, no scripts, nothing loaded from anywhere, light or dark as the reader prefers."""

import base64
import hashlib
from collections.abc import Mapping
from html import escape

from app.viewer.asked import ASKED_BY

__all__ = ["LINK", "SIGN_IN_POLICY", "sign_in_html"]

LINK = (*ASKED_BY, "camera", "track")
"""What a deep link may ask for."""

_STYLE = """
:root{color-scheme:light dark;--page:#f4f6f8;--card:#fff;--ink:#1b2330;--soft:#536072;--line:#8a97a8;--act:#31688e;
  --bad:#b3261e}
@media (prefers-color-scheme:dark){:root{--page:#14161a;--card:#1e2127;--ink:#e9ecef;--soft:#a9b4c2;--line:#5d6877;
  --act:#35a38a;--bad:#ff8a80}}
*{box-sizing:border-box}
body{margin:0;min-height:100vh;display:grid;place-items:center;background:var(--page);color:var(--ink);
  font:16px/1.5 system-ui,sans-serif}
main{width:min(24rem,calc(100vw - 2rem));padding:2rem;border-radius:.75rem;background:var(--card);
  box-shadow:0 8px 30px rgba(0,0,0,.12)}
.stripe{height:.4rem;border-radius:.2rem;margin-bottom:1.4rem;
  background:linear-gradient(to right,#440154,#3b528b,#21918c,#5ec962,#fde725)}
h1{font-size:1.4rem;margin:0 0 .25rem}
p{margin:0 0 1.25rem;color:var(--soft)}
label{display:block;font-weight:600;margin-bottom:.35rem}
input{width:100%;padding:.65rem .75rem;font:inherit;color:inherit;background:transparent;border:1px solid var(--line);
  border-radius:.45rem}
button{width:100%;margin-top:1rem;padding:.7rem;font:inherit;font-weight:600;color:#fff;background:var(--act);border:0;
  border-radius:.45rem;cursor:pointer}
@media (prefers-color-scheme:dark){button{color:#0c1512}}
input:focus-visible,button:focus-visible{outline:3px solid var(--act);outline-offset:2px}
.bad{color:var(--bad);font-weight:600;margin:.6rem 0 0}
small{display:block;margin-top:1.25rem;color:var(--soft)}
code{font-size:.9em}
"""
_STYLE_HASH = base64.b64encode(hashlib.sha256(_STYLE.encode()).digest()).decode()
SIGN_IN_POLICY = (
    f"default-src 'none'; style-src 'sha256-{_STYLE_HASH}'; img-src data:; form-action 'self'; base-uri 'none'; "
    "frame-ancestors 'none'"
)


def sign_in_html(action: str, link: Mapping[str, str], wrong_key: bool = False) -> str:
    """The page, which posts the key to `action` and keeps the deep link through signing in."""
    hidden = '<input type="hidden" name="{}" value="{}">'
    kept = "".join(hidden.format(escape(name), escape(value)) for name, value in link.items())
    told = (
        '<p class="bad" id="told" role="alert">This key is not known, was revoked, or may not read maps.</p>'
        if wrong_key
        else ""
    )
    describes = ' aria-describedby="told" aria-invalid="true"' if wrong_key else ""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1"><link rel="icon" href="data:,">'
        f"<title>Sign in · Isodyn</title><style>{_STYLE}</style></head><body><main>"
        '<div class="stripe"></div><h1>Isodyn</h1><p>Magnetic maps of your buildings</p>'
        f'<form method="post" action="{escape(action)}">{kept}<label for="key">API key</label>'
        f'<input id="key" name="key" type="password" required autofocus autocomplete="off"{describes}>'
        f"{told}<button>Sign in</button></form>"
        "<small>A key with the scope <code>map:read</code> is enough. It is sent once and never stored in this browser."
        "</small></main></body></html>"
    )
