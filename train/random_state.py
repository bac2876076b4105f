"""The states of torch's global generators, which dropout draws from."""

from torch import Tensor, cuda, get_rng_state, set_rng_state


def random_state() -> dict[str, Tensor | list[Tensor]]:
    """The CPU's and, where there are any, the GPUs'."""
    return {"cpu": get_rng_state(), "cuda": cuda.get_rng_state_all() if cuda.is_available() else []}


def restore_random_state(state: dict[str, Tensor | list[Tensor]]) -> None:
    """What `random_state` gave, on as many GPUs as there were and are."""
    set_rng_state(state["cpu"])
    for device, values in zip(range(cuda.device_count()), state["cuda"], strict=False):
        cuda.set_rng_state(values, device)
