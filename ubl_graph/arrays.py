"""Array types, and the checks that every record and geometry class shares."""

from __future__ import annotations

from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
IntArray: TypeAlias = NDArray[np.int64]
BoolArray: TypeAlias = NDArray[np.bool_]
#: What a user may pass where an array of numbers is meant.
ArrayLike: TypeAlias = Any


def frozen(array: ArrayLike, dtype: Any = np.float64) -> NDArray[Any]:
    """Return a read-only copy of `array` with the given dtype."""
    copy = np.array(array, dtype=dtype)
    copy.setflags(write=False)
    return copy
