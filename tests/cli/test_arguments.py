"""Methods with options of their own, as they are written on the command line."""

from dataclasses import replace

import pytest

from jaxfit.cli.arguments import variant
from jaxfit.descriptors import DESCRIPTORS
from jaxfit.descriptors.sift import Sift
from jaxfit.errors import InputError
from jaxfit.image.frame import Frame
from jaxfit.learning.methods import METHODS, Options, seen

GIVEN = Options(ridge=3.0, sigmas=4.0, descriptor=Sift("principal", "vector"), frame=Frame(100, 60.0))


@pytest.mark.parametrize("method", METHODS)
def test_a_bare_name_changes_nothing(method: str) -> None:
    assert variant(method, lambda _: GIVEN) == (method, GIVEN)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ("ridge=2,variance=0.9", replace(GIVEN, ridge=2.0, variance=0.9)),
        ("augmentations=7,windows=0.2", replace(GIVEN, windows=(0.2,), augmentations=7)),
        ("windows=0.4,3e-1,seed=7", replace(GIVEN, windows=(0.4, 0.3), seed=7)),
        ("mirror=false,haar=True", replace(GIVEN, mirror=False, haar=True)),
        ("head=mine.safetensors", replace(GIVEN, head="mine.safetensors")),
        ("normalisation=cell", replace(GIVEN, descriptor=Sift("principal", "cell"))),
        # Neither would go with the other's old value.
        ("face=200,crop=240", replace(GIVEN, frame=Frame(240, 200.0))),
    ],
)
def test_keys_change_their_options_and_no_others(keys: str, expected: Options) -> None:
    assert variant(f"sdm:{keys}", lambda _: GIVEN) == ("sdm", expected)


def test_every_option_can_be_given() -> None:
    told = [
        f"{key}={','.join(map(str, value)) if isinstance(value, tuple) else value}"
        for part in (GIVEN, GIVEN.descriptor, GIVEN.frame)
        for key, value in vars(part).items()
        if key not in ("descriptor", "frame")
    ]
    assert variant(f"sdm:{','.join(told)}", lambda _: Options()) == ("sdm", GIVEN)


@pytest.mark.parametrize("kind", DESCRIPTORS)
def test_windows_of_several_starts_turn_whatever_the_order_of_the_keys(kind: str) -> None:
    for keys in (f"descriptor={kind},initialisations=3", f"initialisations=3,descriptor={kind}"):
        method, options = variant(f"sdm:{keys}", lambda _: Options())
        assert seen(method, options)[0] == replace(DESCRIPTORS[kind](), orientation="face")
    assert not seen(*variant(f"sdm:descriptor={kind}", lambda _: Options()))[0].turns


def test_a_rank_is_a_whole_number() -> None:
    assert variant("sdm:rank=24", lambda _: GIVEN) == ("sdm", replace(GIVEN, rank=24))
    with pytest.raises(InputError, match="expected rank"):
        variant("sdm:rank=2.5", lambda _: GIVEN)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("asm", "a method among sdm, parametric, alignment3d, regression3d; got 'asm'"),
        (":ridge=1", "got ''"),
        (
            "sdm:",
            "expected key=value with a key among windows, .*, orientation, normalisation, crop, face, shift; got ''",
        ),
        ("sdm:frame=3", "got 'frame'"),
        ("sdm:Ridge=3", "got 'Ridge'"),
        ("sdm:ridge", "expected ridge to be like 3.0; got ''"),
        ("sdm:ridge=1=2", "got '1=2'"),
        ("sdm:augmentations=1.5", "expected augmentations to be like 5; got '1.5'"),
        ("sdm:mirror=1", "expected mirror to be like True; got '1'"),
        ("sdm:windows=0.3;0.2", "got '0.3;0.2'"),
        ("sdm:ridge=-1", "ridge, spread and seed >= 0"),
        ("sdm:crop=50", "face 60"),
    ],
)
def test_wrong_methods_are_told_what_is_right(text: str, words: str) -> None:
    with pytest.raises(InputError, match=f"--method {text}: .*{words}"):
        variant(text, lambda _: GIVEN)
