"""How many paths a fit of a cell traces, and in which stages."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True)
class Stage:
    """Steps at the end of a fit, each of which traces the same number of paths."""

    paths: int
    """Paths of a light and batch."""
    batches: int
    thin_steps: int
    """Largest number of steps in a thin cell."""
    thick_steps: int
    """The same in a thick cell; see ``prior.is_thick``."""

    def max_steps(self, *, thick: bool) -> int:
        """Largest number of steps."""
        return self.thick_steps if thick else self.thin_steps

    def scaled(self, effort: float) -> Stage:
        """The same stage with ``effort`` times the paths."""
        return replace(self, paths=max(1, round(effort * self.paths)))


@dataclass(frozen=True)
class Budget:
    """Work of a fit, counted in paths, so that a fit repeats. Paths are those of a light and batch."""

    batches: int = 8
    first_paths: int = 4000
    search_paths: int = 8000
    """Largest number of paths in the search."""
    last: tuple[Stage, ...] = (Stage(15_000, 16, 4, 8), Stage(30_000, 24, 12, 32))
    """The last stages. Renders of the last one are combined, until their noise is no longer the larger part of the
    ±."""
    max_steps: int = 10
    """Largest number of steps in the search."""
    final_paths: int = 120_000
    """Paths of each of the two renders that the images' errors are taken from."""

    def scaled(self, effort: float) -> Budget:
        """The same budget with ``effort`` times the paths."""
        return replace(
            self,
            first_paths=max(1, round(effort * self.first_paths)),
            search_paths=max(1, round(effort * self.search_paths)),
            final_paths=max(1, round(effort * self.final_paths)),
            last=tuple(stage.scaled(effort) for stage in self.last),
        )
