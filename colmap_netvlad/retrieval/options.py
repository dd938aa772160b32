"""What a user chooses about retrieval."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from colmap_netvlad.runtime.errors import InputError

COMPARED = 100
"""Most candidates of each image that are compared place by place where nothing else is said."""


DEPTH = 200
DEPTH_FACTOR = 4
"""A ranking lists at least 200 partners, or four times k: what its first k miss is chosen from
these by rules, in rounds and between components."""

SEARCH_DEPTH = 400
"""Global descriptors are asked for at least this many candidates: what one of several rankings
does not list cannot be fused, and what none lists cannot be compared."""


HIGHEST_SEED = 2**31 - 2
"""faiss takes the next number, as a signed one of 32 bits."""


def ranking_depth(k: int) -> int:
    """Return how many partners a ranking lists where each image gets `k`."""
    return max(DEPTH, DEPTH_FACTOR * k)


def check_k(k: int, num_images: int) -> int:
    """Return `k` clamped to the number of possible partners.

    Raises:
        InputError: `k` is not positive, or there are fewer than two images.
    """
    if k < 1:
        raise InputError(f"`k` is {k}; it is the number of partners of each image, at least 1.")
    if num_images < 2:
        raise InputError(
            f"The database has {num_images} image{'s' if num_images != 1 else ''}; "
            "a pair needs two. Import the photos with `colmap-netvlad features`."
        )
    return min(k, num_images - 1)


@dataclass(frozen=True)
class RetrievalOptions:
    """What a user chooses about retrieval; a method uses what concerns it.

    Attributes:
        k: partners of each image, at least 1; some methods rank deeper.
        model: a checkpoint that `hybrid` and files of descriptors run as their deep model, and
            that ranks instead of any other method; in a comparison others keep to themselves.
        device: where networks run; None: cuda where there is one, else cpu.
        seed: of every random choice, 0 to `HIGHEST_SEED`.
        batch_size: photos described at once; None: the method's own.
        vocab_tree: the vocabulary tree of `bow`; None: see `bow.find_tree`.
        exact: True or False forces exact search or HNSW by the model's descriptors as they are;
            None: see `words.serves` and `search.EXACT_UP_TO`.
        masks: folder of masks in COLMAP's way: masked areas are neutral to deep descriptors;
            photos without a mask are described whole.
        gps: whether positions re-weight the candidates, one of `GPS_MODES`; None: "auto" where
            candidates are compared place by place, which decides, else "off".
        rerank: most candidates of each image that deep methods compare place by place
            (`retrieval.rerank`); 0: none, the descriptors alone.
    """

    k: int = 30
    model: Path | str | None = None
    device: str | None = None
    seed: int = 0
    batch_size: int | None = None
    vocab_tree: Path | None = None
    exact: bool | None = None
    masks: Path | None = None
    gps: str | None = None
    rerank: int = COMPARED


GPS_MODES = ("auto", "off", "require")
"""Use positions where there are useful ones, never, or fail where there are none."""
