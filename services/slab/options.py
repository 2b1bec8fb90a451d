"""Options of a slab's fit."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field, model_validator

from services.core.geometry import Record
from services.core.slab.dictionaries import DEFAULT_DICTIONARY, known_dictionary, require_particles


class SlabOptions(Record):
    """Options of a fit; see the fields of the same names of ``JobSpec``."""

    seed: int = 1
    effort: float = 1.0
    """Paths, in units of the default budget."""
    dictionary: Annotated[str, AfterValidator(known_dictionary)] = DEFAULT_DICTIONARY
    particle_index: float | None = Field(default=None, description="of dictionary mie: real part")
    particle_absorption: float = Field(default=0.0, ge=0, description="of dictionary mie: imaginary part, not negative")

    @model_validator(mode="after")
    def _particles_of_mie(self) -> SlabOptions:
        require_particles(self.dictionary, self.particle_index, self.particle_absorption)
        return self
