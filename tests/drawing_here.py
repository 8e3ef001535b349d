"""Whether images can be drawn here; where not, the tests of images say that they did not run."""

import pytest

from midway.envs.rendering import backend
from midway.errors import ConfigurationError


def _why_not():
    try:
        backend()
    except ConfigurationError as error:
        return f"not run: {error}"
    return ""


WHY_NOT = _why_not()

needs_renderer = pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT or "images can be drawn")
