from __future__ import annotations

import pytest

from wheelleg_exp.run.secrecy import secret_content, secret_keys, secret_name, secret_variables, without_credentials


@pytest.mark.parametrize(
    "path",
    [
        ".env",
        "a/.env.local",
        "id_rsa",
        "keys/id_ed25519",
        "server.PEM",
        "x.key",
        "hf_token",
        "api_token.txt",
        "secrets.yaml",
        "credentials.json",
        ".netrc",
        ".git-credentials",
        "passwords.csv",
        "prod.env",
        "home/.ssh/config",
        ".aws/config",
        "deploy_rsa",
        "service_account_1.json",
        "rclone.conf",
        ".pgpass",
    ],
)
def test_names_of_keys_and_tokens_are_known(path):
    assert secret_name(path)


@pytest.mark.parametrize(
    "path",
    ["tokenizer.py", "token/readme.md", ".env.example", "id_rsa.pub", "code.py", "keys.md", "env.yaml"],
)
def test_names_of_program_text_are_not_taken_for_keys(path):
    assert secret_name(path) is None


@pytest.mark.parametrize("kind", ["", "RSA ", "OPENSSH ", "EC ", "ENCRYPTED "])
def test_a_private_key_is_known_by_its_header(kind):
    assert secret_content(b"x\n" + f"-----BEGIN {kind}PRIVATE".encode() + b" KEY-----\nMII")


def test_an_access_token_is_known_by_its_form():
    assert secret_content(b"url = https://gh" + b"p_" + b"a1" * 18 + b"@host")


@pytest.mark.parametrize(
    "token",
    [
        "ASIA" + "Q" * 16,
        "AIza" + "a" * 35,
        "xoxb" + "-1234567890-abcdefghij",
        "sk-ant" + "-api03-" + "a" * 20,
        "npm_" + "a" * 36,
        "eyJ" + "a" * 12 + ".eyJ" + "b" * 12 + "." + "c" * 12,
    ],
)
def test_tokens_of_many_services_are_known(token):
    assert secret_content(f"key: {token}\n".encode())
    assert list(secret_keys({"a": [{"b": token}]})) == [("a.0.b", "it holds a private key or an access token")]


def test_a_key_that_says_it_holds_a_secret_is_one_and_numbers_are_not():
    tree = {"wandb": {"api_key": "abc", "token": None, "secret": ""}, "password": "x", "token_dim": "y", "max_token": 3}
    assert [path for path, _ in secret_keys(tree)] == ["wandb.api_key", "password"]


@pytest.mark.parametrize("name", ["MY_TOKEN", "HF_TOKEN_2", "wandb_api_key", "DB_PASSWORD", "CLIENT_SECRET", "SSH_KEY"])
@pytest.mark.parametrize(
    "asked", ["${oc.env:%s}", "${ oc.env : %s , x}", "'${oc.env:''%s''}'", '"a-${oc.env:\\"%s\\"}"']
)
def test_a_variable_whose_name_says_secret_is_found_however_it_is_asked_for(name, asked):
    assert secret_variables(f"run:\n  name: {asked % name}\n") == [name]


@pytest.mark.parametrize("name", ["ROBOT_MASS", "KEYFRAME", "MONKEYS", "USER", "WHEELLEG_USD_CORPUS"])
def test_other_variables_may_be_asked_for(name):
    assert secret_variables(f"a: ${{oc.env:{name}}}, and {name}_TOKEN is only named") == []


@pytest.mark.parametrize("content", [b"", b"-----BEGIN PUBLIC KEY-----", b"a PRIVATE KEY here", bytes(range(256))])
def test_other_content_is_not_taken_for_a_key(content):
    assert secret_content(content) is None


@pytest.mark.parametrize(
    ("url", "shown"),
    [
        ("https://user:token@host.org/a/b.git", "https://host.org/a/b.git"),
        ("https://token@host.org:8443/a.git?access_token=1#x", "https://host.org:8443/a.git"),
        ("ssh://git:pw@host.org:22/a.git", "ssh://git@host.org:22/a.git"),
        ("git@host.org:a/b.git", "git@host.org:a/b.git"),
        ("/srv/git/a.git", "/srv/git/a.git"),
        ("file:///srv/git/a.git", "file:///srv/git/a.git"),
    ],
)
def test_an_address_is_kept_without_its_credentials(url, shown):
    assert without_credentials(url) == shown
