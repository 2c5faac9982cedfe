"""What the words of a refusal must hold."""

import re

import pytest

from pipistrelle.config import InputError


def refusal_of(call, *parts, form=r""):
    """Return the message of the `InputError` of a call; it has these parts, and this form."""
    with pytest.raises(InputError) as error:
        call()
    message = str(error.value)
    assert re.search(form, message), message
    for part in parts:
        assert part in message, message
    return message


FORM = r": found .+, expected .+; .+"
"""Place, what was found, what was expected, and the fix."""
