"""Environment variables that look like settings and are none."""

import difflib
import re
from collections.abc import Collection, Mapping

PREFIX = "FORECAST_"
CONFIG = PREFIX + "CONFIG"
"""Names the settings' file."""

# Kubernetes (and Docker's links) tell every container of a service "forecast" by variables of its own.
_SERVICE_LINK = re.compile(r"(.*_)?(SERVICE_HOST|SERVICE_PORT(_.*)?|PORT_\d+_(TCP|UDP|SCTP)(_.*)?)")
_SERVICE_PORT = re.compile(r"(.*_)?PORT")
_SERVICE_ADDRESS = ("tcp://", "udp://", "sctp://")


def unknown_variable(environment: Mapping[str, str], settings: Collection[str]) -> str | None:
    """What is wrong with the first variable that sets nothing, and what may have been meant; None where
    all of them set something. Upper and lower case are the same, as they are to the settings.

    Args:
        environment: all variables; those of other programs are passed over.
        settings: names of the settings, in lower case.
    """
    known = {PREFIX + name.upper() for name in settings} | {CONFIG}
    for name, value in sorted(environment.items()):
        upper = name.upper()
        if not upper.startswith(PREFIX) or upper in known:
            continue
        if not _is_service_link(upper.removeprefix(PREFIX), value):
            [nearest] = difflib.get_close_matches(upper, sorted(known), n=1, cutoff=0.0)
            return f"{name}: there is no such setting; the nearest is {nearest}"
    return None


def _is_service_link(name: str, value: str) -> bool:
    if _SERVICE_LINK.fullmatch(name):
        return True
    return _SERVICE_PORT.fullmatch(name) is not None and value.startswith(_SERVICE_ADDRESS)
