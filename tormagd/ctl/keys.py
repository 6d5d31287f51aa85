"""`tormagctl keys`: make key pairs, show fingerprints."""

from collections.abc import Sequence
from pathlib import Path

from tormagd.ctl.outcome import Outcome, as_usage_error, usage_error
from tormagd.ground.access_keys import load_folder
from tormagd_client.endpoints import ConfigError
from tormagd_client.keys import PUBLIC, SERVER, fingerprint, generate, load_public


def generate_keys(folder: Path, **clients: Sequence[str]) -> Outcome:
    """Make the daemon's key pair if there is none, and one for each of `clients`."""
    made, names = [], [name for listed in clients.values() for name in listed]
    if twice := next((name for name in names if names.count(name) > 1), ""):
        raise usage_error(f"{twice}: allowed is one folder", f"copy its {PUBLIC} into the other one afterwards")
    with as_usage_error(OSError, ConfigError, hint="tormagctl keys generate --help; the guide has the whole exchange"):
        if not (folder / f"{SERVER}{PUBLIC}").exists() or not any(clients.values()):
            made.append(_made(SERVER, SERVER, folder, folder))
        for role, listed in clients.items():
            (folder / role).mkdir(mode=0o700, exist_ok=True)
            made += [_made(name, role, folder, folder / role) for name in listed]
    lines = [
        f"{key['name']} ({key['role']}) {key['fingerprint']}\n  secret {key['secret']}\n  public {key['public']}"
        for key in made
    ]
    return Outcome({"made": made}, "\n".join(lines))


def show_keys(path: Path) -> Outcome:
    """Return the fingerprint of a key file, or of every `NAME.key` in a folder."""
    with as_usage_error(ConfigError, hint="give a .key or .key_secret file, or a folder of them"):
        found = load_folder(path) if path.is_dir() else [(path.stem, load_public(path).decode())]
        keys = [{"name": name, "fingerprint": fingerprint(public)} for name, public in found]
    return Outcome({"keys": keys}, "\n".join(f"{key['fingerprint']}  {key['name']}" for key in keys) or "no keys")


def _made(name: str, role: str, secret_in: Path, public_in: Path) -> dict[str, str]:
    secret, public = generate(name, secret_in, public_in)
    return {
        "name": name,
        "role": role,
        "secret": str(secret),
        "public": str(public),
        "fingerprint": fingerprint(load_public(public)),
    }
