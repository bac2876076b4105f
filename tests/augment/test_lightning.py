import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader

import norm_balls as nb
from renderer.errors import InputError

lightning = pytest.importorskip("lightning")
pytestmark = [pytest.mark.ecosystem, pytest.mark.filterwarnings("default")]


class Module(lightning.LightningModule):
    def __init__(self):
        super().__init__()
        self.network = nn.Sequential(nn.Flatten(), nn.Linear(3 * 8 * 8, 2))
        self.seen = []

    def forward(self, images):
        return self.network(images)

    def training_step(self, batch, index):
        images, labels = batch
        self.seen.append((self.current_epoch, images.clone(), labels))
        return nn.functional.cross_entropy(self(images), labels)

    def configure_optimizers(self):
        return torch.optim.SGD(self.parameters(), 0.1)


@pytest.mark.parametrize("workers", [0, 2])
def test_each_epoch_trains_on_the_renders_of_the_service_for_its_weights(workers, tmp_path):
    service, module = fit(tmp_path, num_workers=workers)
    for epoch, images, labels in module.seen:
        expected = service.regenerate(module, epoch)
        assert torch.equal(images[2:], expected.images)
        assert torch.equal(labels[2:], expected.labels)
    assert len(module.seen) == 2


def test_workers_that_would_keep_the_first_renders_are_refused(tmp_path):
    with pytest.raises(InputError, match="persistent"):
        fit(tmp_path, num_workers=1, persistent_workers=True)


def test_workers_of_a_resumed_run_get_the_renders_of_its_epoch(tmp_path):
    fit(tmp_path, num_workers=1, enable_checkpointing=True)
    [file] = tmp_path.rglob("*.ckpt")
    service, module = fit(tmp_path, num_workers=1, max_epochs=3, ckpt_path=file)
    [(epoch, images, _)] = module.seen
    assert epoch == 2 and torch.equal(images[2:], service.regenerate(module, 2).images)


def fit(tmp_path, max_epochs=2, enable_checkpointing=False, ckpt_path=None, **of_loader):
    settings = nb.AugmentationSettings(mode="random")
    meshes = [("solid:orange", 0), ("solid:cup", 1)]
    options = {"views": 2, "backgrounds": [0.5], "samples": 1}
    service = nb.AugmentationService.from_meshes(meshes, 8, settings, **options)
    callback = nb.lightning_callback(service)
    data = [(torch.zeros(3, 8, 8), 0)] * 2
    module = Module()
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False}
    quiet |= {"enable_checkpointing": enable_checkpointing, "accelerator": "cpu"}
    options = {"max_epochs": max_epochs, "callbacks": [callback], "default_root_dir": tmp_path}
    trainer = lightning.Trainer(**options, **quiet)
    both = torch.utils.data.ConcatDataset([data, callback.renders])
    trainer.fit(module, DataLoader(both, batch_size=6, **of_loader), ckpt_path=ckpt_path)
    return service, module
