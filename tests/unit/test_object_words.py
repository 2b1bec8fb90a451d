"""What is said of an object that is no tooth names no tooth."""

from __future__ import annotations

import pytest

from services.core.pages.object_words import of_an_object, part_of_a_tooth, part_of_an_object, renamed
from services.fit.checks.identifiability import NOT_EXPLAINED, PARTLY_EXPLAINED


def test_parameters_are_those_of_body_and_core() -> None:
    names = {"enamel.sigma_a": "body.sigma_a", "dentin.g1": "core.g1", "gain.green": "gain.green"}
    assert renamed({old: old for old in names}) == {new: old for old, new in names.items()}
    assert [part_of_a_tooth(part_of_an_object(name)) for name in names] == list(names)


@pytest.mark.parametrize(
    ("told", "expected"),
    [
        (
            "This capture tells enamel scattering (1.10 ± 0.02 per mm), but not dentin absorption (anything fits).",
            "This capture tells body scattering (1.10 ± 0.02 per mm), but not core absorption (anything fits).",
        ),
        (
            "Camera c0 stands 3 mm from the teeth's centre, inside their 5 mm radius; its pose must be in millimetres.",
            "Camera c0 stands 3 mm from the object's centre, inside its 5 mm radius; its pose must be in millimetres.",
        ),
        ("The teeth span 2 px in camera c0", "The object spans 2 px in camera c0"),
        ("No tooth projects into the image of camera c0", "No part of the object projects into the image of camera c0"),
        ("Teeth are 3 times as bright as a white", "Objects are 3 times as bright as a white"),
        ("is dark: no tooth is above the noise", "is dark: nothing of the object is above the noise"),
        ("green: the mesh of tooth 0 is shifted", "green: the object's mesh is shifted"),
        ("A light at the left behind the tooth would help", "A light at the left behind the object would help"),
    ],
)
def test_sentences_speak_of_the_object(told: str, expected: str) -> None:
    assert of_an_object(told) == expected


def test_sentences_of_a_fit_that_fails_speak_of_the_object() -> None:
    for sentence in (NOT_EXPLAINED, PARTLY_EXPLAINED):
        assert "tooth" not in of_an_object(sentence)
    doubt = "more than the standard errors contain. In virtual mouths with such errors, coefficients were 11 off. More."
    assert of_an_object(doubt) == "more than the standard errors contain. More."
