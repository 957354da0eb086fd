# SPDX-License-Identifier: GPL-3.0-or-later
"""Weights that ship with the add-on: safetensors files, each refused unless it is the one that was trained.

The format (Hugging Face, "safetensors"): 8 bytes little-endian, the length of a JSON header; the
header, a map from names to dtype, shape and offsets; the numbers.
"""
from __future__ import annotations

import hashlib
import json
import struct
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .errors import UserError
from .exchange import atomic
from .hybrid import Layer, Network

FOLDER = Path(__file__).parent / "networks"
HYBRID, GNN, SKY = "hybrid.safetensors", "gnn.safetensors", "sky.safetensors"
BOUNCES = "bounces.safetensors"  # reads the codes of SKY
EMBEDDING, RADIANCE = "embedding.safetensors", "radiance.safetensors"  # the latter reads the codes of the former
CHECKSUMS = "checksums.json"  # file name -> SHA-256, beside the weights


def save(path: Path, arrays: dict[str, NDArray[np.float32]], about: dict[str, str] | None = None) -> None:
    """Write arrays, and note the file's checksum beside it."""
    header: dict[str, object] = {"__metadata__": about or {}}
    at = 0
    for name, array in arrays.items():
        size = array.size * 4
        header[name] = {"dtype": "F32", "shape": list(array.shape), "data_offsets": [at, at + size]}
        at += size
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    data = struct.pack("<Q", len(text)) + text + b"".join(
        np.ascontiguousarray(a, dtype="<f4").tobytes() for a in arrays.values())
    with atomic(path) as draft:
        draft.write_bytes(data)
    sums = path.parent / CHECKSUMS
    known = json.loads(sums.read_text()) if sums.exists() else {}
    known[path.name] = hashlib.sha256(data).hexdigest()
    with atomic(sums) as draft:
        draft.write_text(json.dumps(known, indent=2, sort_keys=True) + "\n")


def load(path: Path) -> dict[str, NDArray[np.float32]]:
    """The arrays of a file.

    Raises:
        UserError: it is missing, cut, or not the one that the checksum is of; named.
    """
    try:
        data = path.read_bytes()
        known = json.loads((path.parent / CHECKSUMS).read_text())[path.name]
    except (OSError, ValueError, KeyError) as error:
        raise UserError(f"The weights '{path.name}' are missing; install the add-on again.") from error
    if hashlib.sha256(data).hexdigest() != known:
        raise UserError(f"The weights '{path.name}' are damaged or were changed; install the add-on again.")
    length, = struct.unpack_from("<Q", data)
    header = json.loads(data[8:8 + length])
    return {name: np.frombuffer(data, "<f4", (to - start) // 4, 8 + length + start).reshape(entry["shape"])
            for name, entry in header.items() if name != "__metadata__"
            for start, to in [entry["data_offsets"]]}


def filled(module: Any, arrays: dict[str, NDArray[np.float32]]) -> Any:
    """A torch module with copies of these arrays as its weights, in `eval` mode."""
    import torch

    module.load_state_dict({key: torch.from_numpy(array.copy()) for key, array in arrays.items()})
    return module.eval()


def save_hybrid(path: Path, network: Network) -> None:
    """Write the network of `hybrid.filtered`."""
    save(path, {f"{p}.{n}.{kind}": getattr(layer, kind) for p, layers in enumerate(network)
                for n, layer in enumerate(layers) for kind in ("weight", "bias")})


@lru_cache(maxsize=1)
def load_hybrid(path: Path = FOLDER / HYBRID) -> Network:
    """The network of `hybrid.filtered`. Raises UserError as `load`."""
    arrays = load(path)
    passes = 1 + max(int(name.split(".")[0]) for name in arrays)
    depth = 1 + max(int(name.split(".")[1]) for name in arrays)
    return [[Layer(arrays[f"{p}.{n}.weight"], arrays[f"{p}.{n}.bias"]) for n in range(depth)] for p in range(passes)]


@lru_cache(maxsize=1)
def load_gnn(path: Path = FOLDER / GNN) -> dict[str, NDArray[np.float32]]:
    """The network of `gnn.answer`. Raises UserError as `load`."""
    return load(path)
