"""Published protocols: what they are is said, and where the data are not those of publications."""

import pytest

from jaxfit.errors import InputError
from jaxfit.evaluation.protocols import PROTOCOLS, protocol_notes
from jaxfit.labels.records import Dataset
from jaxfit.schemes.known import AFLW21, IBUG68
from jaxfit.schemes.normalisers import NORMALISERS


@pytest.mark.parametrize("name", PROTOCOLS)
def test_what_a_protocol_is_and_is_not_is_said(name: str) -> None:
    protocol = PROTOCOLS[name]
    assert NORMALISERS[protocol.normaliser].known_of(IBUG68)
    first, second = protocol_notes(name, [Dataset("pts:some", IBUG68, ())])
    assert first == f"{name}: {protocol.about}"
    assert "these are 0: figures are not those of publications" in second


def test_wrong_protocols_are_refused() -> None:
    with pytest.raises(InputError, match="aflw2000 is about faces of 68 points; got 21"):
        protocol_notes("aflw2000", [Dataset("aflw:some", AFLW21, ())])
    with pytest.raises(InputError, match=r"expected a protocol of 300w-common, .*; got 'cofw'"):
        protocol_notes("cofw", [])
