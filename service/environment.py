"""Detection of misspelt environment variables: those that look like settings but are none."""

import difflib
import re
from collections.abc import Collection, Mapping

PREFIX = "FORECAST_"
CONFIG = PREFIX + "CONFIG"
"""Variable that names the settings file."""

# Kubernetes (and Docker links) set such variables in every container for a service named "forecast".
_SERVICE_LINK = re.compile(r"(.*_)?(SERVICE_HOST|SERVICE_PORT(_.*)?|PORT_\d+_(TCP|UDP|SCTP)(_.*)?)")
_SERVICE_PORT = re.compile(r"(.*_)?PORT")
_SERVICE_ADDRESS = ("tcp://", "udp://", "sctp://")


def unknown_variable(environment: Mapping[str, str], settings: Collection[str]) -> str | None:
    """Return an error text for the first variable that is no setting, with the nearest setting; else None.

    Case is ignored, as it is for the settings themselves.

    Args:
        environment: all variables; those of other programs are ignored.
        settings: the names of the settings, in lower case.
    """
    known = {PREFIX + name.upper() for name in settings} | {CONFIG}
    for name, value in sorted(environment.items()):
        upper = name.upper()
        if not upper.startswith(PREFIX) or upper in known:
            continue
        if not _is_service_link(upper.removeprefix(PREFIX), value):
            return f"{name}: {no_such_setting(upper, known)}"
    return None


def no_such_setting(name: str, known: Collection[str]) -> str:
    """Return an error text for a name that is no setting, with the nearest one.

    Args:
        name: the name.
        known: the names of the settings, at least one.
    """
    [nearest] = difflib.get_close_matches(name, sorted(known), n=1, cutoff=0.0)
    return f"there is no such setting; the nearest is {nearest}"


def _is_service_link(name: str, value: str) -> bool:
    if _SERVICE_LINK.fullmatch(name):
        return True
    return _SERVICE_PORT.fullmatch(name) is not None and value.startswith(_SERVICE_ADDRESS)
