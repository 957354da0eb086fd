# SPDX-License-Identifier: GPL-3.0-or-later
"""The bakes by the paper's own networks, `mlp` and `gnn-paper`: for comparison. They need torch, imported here."""
from __future__ import annotations

import logging
import sys
import time
from collections.abc import Generator, Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import sight, weights
from . import spherical_harmonics as sh
from .errors import UserError
from .geometry import TEXEL, TriangleMesh
from .graph import Graph, graph
from .neighbours import neighbours
from .raycast import Geometry
from .record import BakeRecord
from .refine import refined
from .transfer import Transfer
from .workers import default_threads

ORDER = 3   # bands that the paper's networks give
_LOGGER = logging.getLogger(__name__)


def import_torch(method: str) -> Any:
    """torch. Raises UserError where it is not installed, or does not start."""
    try:
        import torch
    except (ImportError, OSError) as error:
        raise UserError(f"The method '{method}' needs PyTorch, which this Python has not; get it with "
                        f"'{sys.executable} -m pip install torch', or choose another method.") from error
    return torch


def _bake(mesh: TriangleMesh, order: int, *, rays: int | None, tolerance: float | None,
          occluders: Sequence[Geometry], seed: int, threads: int | None, method: str, scene: None = None
          ) -> Generator[float, None, Transfer]:
    """Ask the network at every point; arguments as `methods.bake`, of which only mesh and order matter.

    Raises:
        UserError: no torch, texels, more bands than the network has, or weights that are not those that were shipped.
    """
    began = time.perf_counter()
    if order > ORDER:
        raise UserError(f"The method '{method}' gives orders up to {ORDER}; choose a lower order or another method.")
    if mesh.domain == TEXEL:
        raise UserError(f"The method '{method}' was made for vertices; bake to them, or choose another method.")
    torch = import_torch(method)
    name = "mlp" if method == "mlp" else "gnn-paper"
    arrays = weights.load(weights.FOLDER / f"{name}.safetensors")
    lit = np.any(mesh.normals != 0, axis=1)
    seen = sight.encode(sight.placed(mesh.points, lit), mesh.normals)
    yield 0.1
    known = None if name == "mlp" else sight.places(mesh.points, mesh.normals)
    edges = (graph(mesh.points, neighbours(mesh)) if name != "mlp"
             else Graph(np.zeros(len(lit) + 1, np.int64), np.zeros(0, np.int64)))
    yield 0.4
    ask = partial(_answer, torch, arrays, seen, edges, known)
    before = torch.get_num_threads()
    torch.set_num_threads(threads or default_threads())
    try:
        blocked = ask("cuda" if torch.cuda.is_available() else "cpu")
    except torch.cuda.OutOfMemoryError:
        _LOGGER.warning("The GPU has too little memory for this mesh; its processor does the work.")
        torch.cuda.empty_cache()
        blocked = ask("cpu")
    finally:
        torch.set_num_threads(before)
    world = blocked if known is None else sh.rotate_each(blocked, known.frames)
    coefficients = sh.cosine_lobe(mesh.normals, order) - world[:, :sh.coefficient_count(order)]
    if method == "gnn-paper-ao":
        coefficients = refined(coefficients, mesh.points, mesh.normals, edges)
    coefficients[~lit] = 0
    return Transfer(coefficients.astype(np.float32), BakeRecord(
        method=method, order=order, points=len(lit), domain=mesh.domain, rays=0, seed=seed,
        seconds=time.perf_counter() - began, error_estimate=None))


def _answer(torch: Any, arrays: dict[str, NDArray[np.float32]], seen: NDArray[np.float32], edges: Graph,
            known: sight.Places | None, device: str) -> NDArray[np.float32]:
    """The blocked part (N, 9), in the motors' frames; without places that of the perceptron, in the mesh's axes."""
    from .networks import paper

    def given(*arrays: NDArray) -> list[Any]:
        return [torch.from_numpy(array).to(device) for array in arrays]

    network = weights.filled(paper.Mlp() if known is None else paper.TwoStage(), arrays).to(device)
    given_ = given(seen, edges.source, edges.start)
    with torch.no_grad():
        if known is None:
            return network(*given_).cpu().numpy()
        return network(*given_, (sight.Sight(*given(*part)) for part in known.sights()))[0].cpu().numpy()


bake_mlp = partial(_bake, method="mlp")
bake_gnn = partial(_bake, method="gnn-paper")
bake_gnn_ao = partial(_bake, method="gnn-paper-ao")
