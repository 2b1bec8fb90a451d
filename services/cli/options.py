"""``dentine options``: the options of a job's TOML file."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

import typer


def options(
    preset: Annotated[
        str | None, typer.Option(help="Print a set of options to begin with instead, such as quick.")
    ] = None,
) -> None:
    """List a job's options as lines of its TOML file: default, meaning, limits."""
    from services.api.presets import find_preset, list_presets
    from services.core.raw.toml_writing import description_toml
    from services.core.records import JobSpec, RigSpec

    if preset is not None:
        chosen = find_preset(preset)
        print(f"# {chosen.summary}\n{description_toml(chosen.options).decode()}", end="")
        return
    print("# Sets to begin with, by dentine options --preset NAME:")
    for one in list_presets():
        print(f"#   {one.name}: {one.summary}")
    for line in _lines(JobSpec.model_json_schema()["properties"]):
        print(line)
    print("\n# In place of capture:\n[rig]")
    for line in _lines(RigSpec.model_json_schema()["properties"]):
        print(line)


def _lines(properties: dict[str, dict[str, Any]]) -> Iterator[str]:
    """One line for each option; options without a default are commented out."""
    from services.core.raw.toml_writing import toml_value

    for name, schema in properties.items():
        default = schema.get("default")
        is_set = default is not None and not isinstance(default, dict)
        value = toml_value(default) if is_set else "..."
        about = [text for text in (schema.get("description"), *_limits(schema)) if text]
        yield f"{'' if is_set else '# '}{name} = {value}" + (f"  # {'; '.join(about)}" if about else "")


def _limits(schema: dict[str, Any]) -> Iterator[str]:
    """The limits of an option's values, in words."""
    for kind in (schema, *schema.get("anyOf", ())):
        if choices := kind.get("enum"):
            yield f"one of {', '.join(map(str, choices))}"
        for key, words in (
            ("minimum", "at least"),
            ("exclusiveMinimum", "above"),
            ("maximum", "at most"),
            ("exclusiveMaximum", "below"),
        ):
            if key in kind:
                yield f"{words} {kind[key]:g}"
