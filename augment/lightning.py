"""A callback that makes the renders of a service anew in each epoch of PyTorch Lightning."""

from contextlib import suppress
from importlib import import_module
from typing import Any

from torch import nn
from torch.utils._pytree import tree_leaves
from torch.utils.data import Dataset

from augment.renders import Renders
from augment.service import AugmentationService
from renderer.errors import InputError, require_kind


class CurrentRenders(Dataset[Any]):
    """The renders of the present epoch as a data set, whose items change with the epochs."""

    def __init__(self, length: int):
        self.current: Renders | None = None
        self._length = length

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, index: int) -> Any:
        if self.current is None:
            raise InputError("the first renders are made by trainer.fit: give the callback to it")
        return self.current[index]


def lightning_callback(service: AugmentationService, network: nn.Module | None = None) -> Any:
    """Create a callback of PyTorch Lightning that renders anew in each epoch.

    Its attribute `renders` is a data set with the renders of the present epoch.
    It can be concatenated with the user's data. The `DataLoader` may have
    workers that are not persistent.

    Args:
        service: The source of renders, on the device of the network.
        network: The network from images in [0, 1] to outputs that is attacked.
            None for the `LightningModule` itself.

    Returns:
        The callback, for `lightning.Trainer(callbacks=[...])`.

    Raises:
        InputError: If PyTorch Lightning is not installed, or if an argument
            has the wrong type.

    Example:
        >>> import norm_balls as nb
        >>> service = nb.AugmentationService.from_meshes([("solid:orange", 53)], 32)
        >>> callback = nb.lightning_callback(service)  # doctest: +SKIP
        >>> loader = DataLoader(data + callback.renders, 128, shuffle=True)  # doctest: +SKIP
        >>> Trainer(callbacks=[callback]).fit(module, loader)  # doctest: +SKIP
    """
    require_kind("service", service, AugmentationService, "nb.AugmentationService.from_meshes(...)")
    require_kind("network", network, nn.Module | None, "a torch.nn.Module or None")
    # Lightning has two packages, of which a user has one.
    for name in ("lightning.pytorch", "pytorch_lightning"):
        with suppress(ImportError):
            base: Any = import_module(name).Callback
            break
    else:
        raise InputError("PyTorch Lightning is not installed: pip install lightning")

    class RendersOfEpoch(base):  # type: ignore[misc]
        """Makes the renders anew when an epoch begins."""

        def __init__(self) -> None:
            self.renders = CurrentRenders(len(service))
            self.epoch = 0

        def regenerate(self, epoch: int, pl_module: Any) -> None:
            """Attack the weights as they are now."""
            self.epoch = epoch
            made = service.regenerate(pl_module if network is None else network, epoch)
            self.renders.current, self.diagnostics = made, made.diagnostics

        def on_load_checkpoint(self, trainer: Any, pl_module: Any, checkpoint: Any) -> None:
            """Keep the epoch, which Lightning restores after workers have copied the renders."""
            self.epoch = checkpoint["loops"]["fit_loop"]["epoch_progress"]["current"]["processed"]

        def on_fit_start(self, trainer: Any, pl_module: Any) -> None:
            """Make the first renders before workers copy them."""
            self.regenerate(max(self.epoch, trainer.current_epoch), pl_module)

        def on_train_epoch_start(self, trainer: Any, pl_module: Any) -> None:
            """Render anew if the epoch has no renders yet, and log numbers about them."""
            loaders = tree_leaves(trainer.train_dataloader)
            if any(getattr(loader, "persistent_workers", False) for loader in loaders):
                reason = "the loader has persistent_workers=True, which keep the first renders"
                raise InputError(f"{reason}: set it to False")
            if self.epoch != trainer.current_epoch:
                self.regenerate(trainer.current_epoch, pl_module)
            for name, value in self.diagnostics.items():
                pl_module.log(f"renders/{name}", value)

    return RendersOfEpoch()
