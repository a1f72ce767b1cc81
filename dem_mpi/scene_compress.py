"""The section `compress` of a scene: which fields go into an archive, and with what error."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Discriminator, Tag, model_validator

from dem_mpi.scene_base import Model, NonNegative, Positive, Whole, note, quantity

# Of these no error has a meaning: a body of half a material.
EXACT_ONLY = ("shape", "material")


class ErrorBound(Model):
    """The error a field may have: one of relative, rmse and pointwise."""

    relative: Positive | None = quantity(
        "1", "Frobenius norm of the error over that of the values, in every chunk", default=None
    )
    rmse: Positive | None = quantity(
        "unit of the field", "Root mean square error in every chunk", default=None
    )
    pointwise: Positive | None = quantity(
        "unit of the field", "Largest error of any number", default=None
    )

    @model_validator(mode="after")
    def _exactly_one(self) -> Self:
        if (self.relative, self.rmse, self.pointwise).count(None) != 2:
            raise ValueError("give exactly one of relative, rmse and pointwise")
        return self

    @property
    def kind(self) -> str:
        """Which of the three is given."""
        kinds = ("relative", "rmse", "pointwise")
        return next((kind for kind in kinds if getattr(self, kind) is not None), "")


def _bound_form(value: Any) -> str:
    if isinstance(value, (ErrorBound, dict)):
        return "<bound>"
    return "<exact>" if isinstance(value, str) else "<number>"


FieldBound = Annotated[
    Annotated[Positive, Tag("<number>")]
    | Annotated[Literal["exact"], Tag("<exact>")]
    | Annotated[ErrorBound, Tag("<bound>")],
    Discriminator(_bound_form),
]


def _bound(text: str) -> Any:
    return quantity(
        "1",
        f"{text}: a relative error, a mapping with one of relative, rmse and pointwise, or exact",
        default=None,
    )


class CompressedFields(Model):
    """What is archived; gid always is, exactly."""

    position: FieldBound | None = _bound("Centre of mass in m")
    velocity: FieldBound | None = _bound("Velocity of the centre of mass in m/s")
    angular_velocity: FieldBound | None = _bound("Angular velocity in rad/s")
    orientation: FieldBound | None = _bound("Unit quaternion, body to world")
    radius: FieldBound | None = _bound("Radius in m")
    half_length: FieldBound | None = _bound("Half the core or polar semi-axis in m")
    shape: Literal["exact"] | None = note("Number of the shape: exact", default=None)
    material: Literal["exact"] | None = note("Number of the material: exact", default=None)

    @model_validator(mode="after")
    def _some(self) -> Self:
        if not self.bounds:
            raise ValueError("give at least one field, for instance velocity: 1e-2")
        return self

    @property
    def bounds(self) -> dict[str, tuple[str, float]]:
        """(kind, value) of every field that is given, as `compress.bounds.Bound` takes them."""
        return {
            name: as_bound(value)
            for name in type(self).model_fields
            if (value := getattr(self, name)) is not None
        }


def as_bound(value: float | str | ErrorBound) -> tuple[str, float]:
    """Kind and value of a bound as it stands in a scene."""
    if isinstance(value, ErrorBound):
        return value.kind, getattr(value, value.kind)
    return ("exact", 0.0) if isinstance(value, str) else ("relative", float(value))


class Compress(Model):
    """A compressed archive of the frames, written while the run goes on."""

    fields: CompressedFields = note("Fields and their bounds; need not be in output.fields")
    chunk: Whole = quantity(
        "1", "Frames that are compressed together: more make a smaller file", default=32, ge=1,
        le=4096,
    )  # fmt: skip
    floor: NonNegative = quantity(
        "1",
        "A relative bound no longer shrinks with a chunk whose root mean square is below this "
        "share of that of the chunks so far",
        default=0.0,
        le=1,
    )
    path: str = note(
        "File name of the archive in the output directory",
        default="run.tt.h5",
        pattern=r"^[^/\\\x00-\x1f]+\.h5$",
        max_length=200,
    )
