"""Types that every section of a scene is built from.

SI units throughout. Every model refuses unknown keys and silent conversions: a quoted "1" is
text, `true` is no number, and neither NaN nor infinity is a value.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, Strict, ValidationInfo, field_validator

Number = Annotated[float, Strict(), Field(allow_inf_nan=False)]
Whole = Annotated[int, Strict()]
Switch = Annotated[bool, Strict()]
Positive = Annotated[Number, Field(gt=0)]
NonNegative = Annotated[Number, Field(ge=0)]
Vec3 = tuple[Number, Number, Number]
Name = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_\-]*$", max_length=64)]
Face = Literal["x_min", "x_max", "y_min", "y_max", "z_min", "z_max"]
FACES: tuple[Face, ...] = ("x_min", "x_max", "y_min", "y_max", "z_min", "z_max")

ZERO: Vec3 = (0.0, 0.0, 0.0)


def quantity(unit: str, text: str, **rules: Any) -> Any:
    """A numeric field whose unit stands in the schema; `unit` "1" means dimensionless."""
    return Field(description=f"{text} [{unit}]", json_schema_extra={"unit": unit}, **rules)


def note(text: str, **rules: Any) -> Any:
    """A field that has no unit: a name, a choice, a switch or a section."""
    return Field(description=text, **rules)


class Model(BaseModel):
    """Base of every part of a scene: immutable, no unknown keys, numbers of moderate size."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @field_validator("*")
    @classmethod
    def _moderate(cls, value: Any) -> Any:
        """Refuse sizes whose squares and cubes would leave the range of float64."""
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float) and number != 0 and not 1e-30 <= abs(number) <= 1e30:
                raise ValueError("must be 0 or between 1e-30 and 1e30 in size")
        return value


class Region(Model):
    """An axis-aligned region with min below max on every axis."""

    min: Vec3 = quantity("m", "Lower corner x, y, z")
    max: Vec3 = quantity("m", "Upper corner x, y, z")

    @field_validator("max")
    @classmethod
    def _above_min(cls, upper: Vec3, info: ValidationInfo) -> Vec3:
        for axis, low, high in zip("xyz", info.data.get("min", upper), upper, strict=True):
            if "min" in info.data and not low < high:
                raise ValueError(f"must be above min on every axis ({axis}: {low:g} and {high:g})")
        return upper
