"""What must not get into a run directory: keys, tokens, and the credentials in an address."""

from __future__ import annotations

import re
from fnmatch import fnmatch
from urllib.parse import urlsplit, urlunsplit

_KEY_FILES = (
    ".env",
    ".env.*",
    "*.env",
    ".netrc",
    "_netrc",
    ".pypirc",
    ".npmrc",
    ".htpasswd",
    ".git-credentials",
    "id_rsa*",
    "id_dsa*",
    "id_ecdsa*",
    "id_ed25519*",
    "*.pem",
    "*.key",
    "*.p12",
    "*.pfx",
    "*.jks",
    "*.keystore",
    "*.kdbx",
    "*.ppk",
)
_EXAMPLES = (".env.example", ".env.sample", ".env.template", "*.pub")

# A word in a name says little about program text (tokenizer.py), and much about data (token.txt).
_WORDS = ("token", "secret", "credential", "password", "passwd", "api_key", "apikey")
_PROGRAM_TEXT = (".py", ".pyi", ".c", ".cc", ".cpp", ".cu", ".h", ".hpp", ".rs", ".js", ".ts", ".md", ".rst")

_KEY_CONTENT = re.compile(
    rb"-----BEGIN [A-Z0-9 ]*PRIVATE KEY( BLOCK)?-----"
    rb"|PuTTY-User-Key-File-[0-9]:"
    rb"|\bgh[pousr]_[A-Za-z0-9]{36}"
    rb"|\bgithub_pat_[A-Za-z0-9_]{22,}"
    rb"|\bglpat-[A-Za-z0-9_-]{20}"
    rb"|\bhf_[A-Za-z0-9]{34}\b"
    rb"|\bAKIA[0-9A-Z]{16}\b"
)


def secret_name(path: str) -> str | None:
    """Return why a file's name says that it holds a key or a token, or None.

    Args:
        path: path with forward slashes; its last part decides.
    """
    name = path.rsplit("/", 1)[-1].lower()
    if any(fnmatch(name, pattern) for pattern in _EXAMPLES):
        return None
    for pattern in _KEY_FILES:
        if fnmatch(name, pattern):
            return f"its name matches {pattern}"
    word = next((word for word in _WORDS if word in name), None)
    if word is not None and not name.endswith(_PROGRAM_TEXT):
        return f"its name holds '{word}'"
    return None


def secret_content(content: bytes) -> str | None:
    """Return why a file's content says that it holds a key or a token, or None."""
    return "it holds a private key or an access token" if _KEY_CONTENT.search(content) else None


def without_credentials(url: str) -> str:
    """Return an address without user, password, query and fragment; the user of ``ssh`` is kept.

    The short form ``git@host:path`` and local paths have no credentials and come back as they are.
    """
    if "://" not in url:
        return url
    try:
        parts = urlsplit(url)
    except ValueError:
        return "(an address that cannot be read)"
    userinfo, at, host = parts.netloc.rpartition("@")
    user = userinfo.split(":", 1)[0] if at and parts.scheme in ("ssh", "git+ssh") else ""
    return urlunsplit((parts.scheme, f"{user}@{host}" if user else host, parts.path, "", ""))
