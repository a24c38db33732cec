"""Annotations as schemas."""

from typing import Any, TypeVar

import numpy as np
import pytest
from typing_extensions import TypeAliasType

from systems.files.schema import fitted

_Kind = TypeVar("_Kind", bound=np.generic)
# What numpy.typing.NDArray is from NumPy 2.5 on.
_Alias = TypeAliasType("_Alias", np.ndarray[tuple[Any, ...], np.dtype[_Kind]], type_params=(_Kind,))


def test_an_array_type_may_be_an_alias() -> None:
    found = fitted([[1, 2], [3, 4]], _Alias[np.int64], "x")
    assert found.dtype == np.int64 and found.tolist() == [[1, 2], [3, 4]]
    with pytest.raises(ValueError, match="x must be an array of whole numbers"):
        fitted([0.5], _Alias[np.int64], "x")
