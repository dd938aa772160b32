"""The models by name. No PyTorch here: help texts and tables read it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from colmap_netvlad.runtime.errors import InputError

SHIPPED = Path(__file__).parent / "weights"
"""The checkpoints that come with the package."""


@dataclass(frozen=True)
class ModelEntry:
    """One named model.

    Attributes:
        name: what `--method` calls it.
        filename: in the package's weights/ folder, or in torch hub's cache where `url` is set.
        summary: one line with its source.
        url: where the user downloads it, or None where it is shipped.
    """

    name: str
    filename: str
    summary: str
    url: str | None = None

    @property
    def path(self) -> Path:
        """Where the file is, or has to be put."""
        return (SHIPPED if self.url is None else hub_folder()) / self.filename

    @property
    def available(self) -> bool:
        """Whether the file is there."""
        return self.path.is_file()

    def file(self) -> Path:
        """The file.

        Raises:
            InputError: it is not there; says where to get it and where to put it.
        """
        if self.available:
            return self.path
        if self.url is None:
            raise InputError(
                f"The weights of {self.name} are missing from this installation "
                f"({self.path}): install colmap-netvlad again."
            )
        raise InputError(
            f"The weights of {self.name} are not shipped: download {self.url} and put it at "
            f"{self.path}, or name the file with `model`."
        )


def hub_folder() -> Path:
    """torch hub's cache of checkpoints, by torch's own rules, without importing torch."""
    cache = Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")) / "torch"
    return Path(os.environ.get("TORCH_HOME", cache)).expanduser() / "hub" / "checkpoints"


CATALOGUE: dict[str, ModelEntry] = {
    entry.name: entry
    for entry in (
        ModelEntry(
            "netvlad-o-lite",
            "netvlad-o-lite.safetensors",
            "NetVLAD on EfficientNet-Lite0, its local features taught by correspondences on drone"
            " flights; fast on a laptop.",
        ),
        ModelEntry(
            "netvlad-o",
            "netvlad-o.safetensors",
            "NetVLAD on VGG-16 conv5_3, the paper's network, its local features taught by"
            " correspondences on drone flights; wants a GPU.",
        ),
        ModelEntry(
            "netvlad-lite-imagenet",
            "netvlad-lite-imagenet.safetensors",
            "NetVLAD on EfficientNet-Lite0, not trained for flights, fast on a laptop.",
        ),
        ModelEntry(
            "netvlad",
            "Pitts30K_struct.mat",
            "NetVLAD on VGG-16 trained on Pittsburgh street views, whitened to 4096"
            " (Arandjelovic et al., CVPR 2016); you download its weights.",
            url="https://cvg-data.inf.ethz.ch/hloc/netvlad/Pitts30K_struct.mat",
        ),
    )
}

DEFAULT = "netvlad-o-lite"
"""The model of `pairs` where no method is named."""
