"""Recognize what must not get into a run directory: keys, tokens, and the credentials in a URL."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from fnmatch import fnmatch
from typing import Any
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
    "*.pkcs12",
    "*_rsa",
    "*_ed25519",
    "*.ovpn",
    ".pgpass",
    ".my.cnf",
    ".s3cfg",
    ".boto",
    ".dockercfg",
    ".authinfo",
    ".vault_pass*",
    "kubeconfig",
    "*.kubeconfig",
    "rclone.conf",
    "secring.*",
    "service_account*.json",
)
# Folders that hold nothing else.
_KEY_FOLDERS = (".ssh", ".gnupg", ".aws", ".azure", ".kube", ".docker", ".gcloud")

_EXAMPLES = (".env.example", ".env.sample", ".env.template", "*.pub")

# A word in a name says little about program text (tokenizer.py), and much about data (token.txt).
_WORDS = ("token", "secret", "credential", "password", "passwd", "passphrase", "api_key", "apikey", "access_key")
_PROGRAM_TEXT = (".py", ".pyi", ".c", ".cc", ".cpp", ".cu", ".h", ".hpp", ".rs", ".js", ".ts", ".md", ".rst")

_KEY_CONTENT = re.compile(
    rb"-----BEGIN [A-Z0-9 ]*PRIVATE KEY( BLOCK)?-----"
    rb"|PuTTY-User-Key-File-[0-9]:"
    rb"|\bgh[pousr]_[A-Za-z0-9]{36}"
    rb"|\bgithub_pat_[A-Za-z0-9_]{22,}"
    rb"|\bglpat-[A-Za-z0-9_-]{20}"
    rb"|\bhf_[A-Za-z0-9]{34}\b"
    rb"|\bA(KIA|SIA)[0-9A-Z]{16}\b"
    rb"|\bAIza[0-9A-Za-z_-]{35}"
    rb"|\bxox[abeoprs]-[0-9A-Za-z-]{20,}"
    rb"|\bsk-(ant|proj|svcacct)-[0-9A-Za-z_-]{20,}"
    rb"|\bnpm_[0-9A-Za-z]{36}\b"
    rb"|\bpypi-AgE[0-9A-Za-z_-]{50,}"
    rb"|\beyJ[0-9A-Za-z_-]{10,}\.eyJ[0-9A-Za-z_-]{10,}\.[0-9A-Za-z_-]{10,}"
    rb"|\bAGE-SECRET-KEY-1[0-9A-Z]{58}"
)

_SECRET_KEY = re.compile(
    r"(.*_)?(token|password|passwd|passphrase|secret|api_?key|access_?key|private_?key|credentials?)"
)


_SECRET_VARIABLE = re.compile(
    r"TOKEN|SECRET|PASSW|PASSPHRASE|CREDENTIAL|(API|ACCESS|AUTH|PRIVATE)_?KEY|(^|_)KEYS?(_?\d+)?$", re.IGNORECASE
)
# Quotes around the name are no part of it; those of YAML may stand around these.
_ASKED = re.compile(r"""\$\{\s*oc\.env\s*:[\s\\"']*([A-Za-z_]\w*)""")


def secret_name(path: str) -> str | None:
    """Return why a file's name says that it holds a key or a token, or None.

    Args:
        path: path with forward slashes; its last part decides, and folders that hold keys alone.
    """
    *folders, name = path.lower().split("/")
    folder = next((part for part in folders if part in _KEY_FOLDERS), None)
    if folder is not None:
        return f"it lies in {folder}"
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


def secret_keys(tree: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the path and the reason of every text in a plain tree that is, or by its key must be, a key or a token."""
    if isinstance(tree, Mapping):
        for key, value in tree.items():
            yield from secret_keys(value, f"{path}.{key}" if path else str(key))
    elif isinstance(tree, list):
        for index, value in enumerate(tree):
            yield from secret_keys(value, f"{path}.{index}")
    elif isinstance(tree, str) and tree:
        reason = secret_content(os.fsencode(tree))
        if reason is not None:
            yield path, reason
        elif _SECRET_KEY.fullmatch(path.rsplit(".", 1)[-1].lower()):
            yield path, "its name says that it holds a secret"


def secret_variables(text: str) -> list[str]:
    """Return the environment variables that a text asks for with ``${oc.env:NAME}`` and whose names say secret."""
    return [name for name in dict.fromkeys(_ASKED.findall(text)) if is_secret_variable(name)]


def is_secret_variable(name: str) -> bool:
    """Return whether the name of an environment variable says that it holds a key or a token."""
    return _SECRET_VARIABLE.search(name) is not None


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
