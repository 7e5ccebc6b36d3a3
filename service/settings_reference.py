"""Reference of the settings: variable, default, allowed values and meaning of each, from the class itself."""

import ast
import inspect
import re
from dataclasses import dataclass
from typing import get_args

import annotated_types
from pydantic.fields import FieldInfo

from service.environment import PREFIX
from service.settings import Settings


@dataclass(frozen=True)
class SettingReference:
    """Facts about one setting, as text."""

    name: str
    """Key in a TOML file."""
    default: str | None
    """None: not set."""
    allowed: str
    """Bounds or choices; empty: any value of its type."""
    meaning: str

    @property
    def variable(self) -> str:
        """Environment variable."""
        return PREFIX + self.name.upper()


def settings_reference() -> list[SettingReference]:
    """Return the settings, in the order of the class."""
    meanings = attribute_docstrings(Settings)
    return [
        SettingReference(
            name, _default(field), _allowed(field), re.sub(r"\bNone: ", "not set: ", meanings[name])
        )
        for name, field in Settings.model_fields.items()
    ]


def attribute_docstrings(cls: type) -> dict[str, str]:
    """Return the docstring of each annotated attribute of a class, on one line."""
    [definition] = ast.parse(inspect.getsource(cls)).body
    assert isinstance(definition, ast.ClassDef)  # noqa: S101 - the source of a class is a class
    found = {}
    for before, after in zip(definition.body, definition.body[1:], strict=False):
        if isinstance(before, ast.AnnAssign) and isinstance(before.target, ast.Name):
            match after:
                case ast.Expr(value=ast.Constant(value=str(text))):
                    found[before.target.id] = " ".join(text.split())
    return found


def _default(field: FieldInfo) -> str | None:
    match field.get_default(call_default_factory=True):
        case None | () | dict():
            return None
        case bool() as switch:
            return str(switch).lower()
        case float() as number:
            return f"{number:.15g}"
        case value:
            return str(value)


def _allowed(field: FieldInfo) -> str:
    bounds = []
    for limit in field.metadata:
        match limit:
            case annotated_types.Gt(gt=bound):
                bounds.append(f"> {bound:.15g}")
            case annotated_types.Ge(ge=bound):
                bounds.append(f"≥ {bound:.15g}")
    if bounds:
        return ", ".join(bounds)
    return ", ".join(choice for choice in get_args(field.annotation) if isinstance(choice, str))
