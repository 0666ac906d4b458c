"""Where worlds are stepped: on the processor, or on a CUDA GPU with a build of the core that has it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import TYPE_CHECKING, Any, Literal

from endopilot import _core
from endopilot.errors import InputError

if TYPE_CHECKING:
    from endopilot._core import Lumen, Options, RodModel, Simulation, Tubes
    from endopilot._core import Motion as CoreMotion
    from endopilot._core import Transmission as CoreTransmission
else:  # each build of the core has classes of its own
    CoreMotion = CoreTransmission = Lumen = Options = RodModel = Simulation = Tubes = Any

Processor = Literal["cpu", "cuda"]
"""Where worlds are stepped: the processor's threads, or a CUDA GPU."""


def core_for(processor: Processor) -> Any:
    """Return the core's module that steps worlds there; it has the same names as `endopilot._core`.

    Raises:
        InputError: a GPU is asked for, and this installation or this machine has none.
    """
    if processor == "cpu":
        return _core
    try:
        core: Any = import_module("endopilot._core_cuda")
    except ModuleNotFoundError:
        raise InputError(
            "processor: 'cuda': endopilot was built without it; build it with -C cmake.define.ENDOPILOT_CUDA=ON, "
            "or give 'cpu'"
        ) from None
    missing = core.why_no_gpu()
    if missing:
        raise InputError(f"processor: 'cuda': no GPU can be used here ({missing}); give 'cpu'")
    return core


@contextmanager
def gpu_errors(processor: Processor) -> Iterator[None]:
    """Turn what a GPU reports, such as too little memory, into an error for people.

    Raises:
        InputError: the GPU failed.
    """
    try:
        yield
    except RuntimeError as error:
        if processor == "cpu":
            raise
        raise InputError(f"processor: 'cuda': {error}; simulate fewer worlds at once, or give 'cpu'") from None
