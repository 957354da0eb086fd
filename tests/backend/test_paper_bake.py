# SPDX-License-Identifier: GPL-3.0-or-later
"""The bakes by the paper's networks: what they need, what they refuse, and that nothing else needs torch."""
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from neural_gash_addon.backend import methods, metrics, paper_bake, texture, weights
from neural_gash_addon.backend import spherical_harmonics as sh
from neural_gash_addon.backend.errors import UserError
from neural_gash_addon.backend.geometry import TriangleMesh

from . import shapes
from .test_hybrid import knot
from .test_texture import surface

PAPERS = ["mlp", "gnn-paper", "gnn-paper-ao"]


def bake(mesh, method, order=3):
    return methods.run(methods.bake(mesh, method, order)).coefficients


@pytest.mark.parametrize("method", PAPERS)
def test_without_torch_one_sentence_says_how_to_get_it(method, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)  # what an import finds where there is none
    with pytest.raises(UserError, match="needs PyTorch.*pip install torch"):
        bake(TriangleMesh.from_triangles(*shapes.sphere(1)), method)


def test_everything_else_does_without_torch():
    program = """
import sys
sys.modules["torch"] = None
import numpy as np
from neural_gash_addon.backend import methods
from neural_gash_addon.backend.geometry import TriangleMesh
mesh = TriangleMesh.from_triangles(np.eye(4, 3), np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))
for name, method in methods.METHODS.items():
    if "PyTorch" not in method.label:
        methods.run(methods.bake(mesh, name, 3, rays=4 if method.traces else None))
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True,
                          cwd=Path(__file__).parents[2], check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("method", PAPERS)
def test_orders_and_texels_that_they_do_not_have_are_refused(method):
    mesh = TriangleMesh.from_triangles(*shapes.sphere(1))
    with pytest.raises(UserError, match="orders up to 3"):
        bake(mesh, method, 5)
    with pytest.raises(UserError, match="vertices"):
        methods.run(texture.bake(surface(shapes.sphere(1)), method, 3, side=32))


@pytest.mark.parametrize("method", PAPERS)
@pytest.mark.parametrize(("positions", "triangles"), [
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]),
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0], [5, 5, 5]], [[0, 1, 2]]),
    ([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]]),
    ([[1, 1, 1]] * 3, [[0, 1, 2]]),
    ([[0, 0, 0], [1e18, 0, 0], [0, 1e18, 0]], [[0, 1, 2]]),
    ([[0, 0, 0], [1, 0, 0], [0, 1, 0]] * 2, [[0, 1, 2], [3, 4, 5]])],
    ids=["three vertices", "isolated vertex", "a line", "one place", "enormous", "duplicates"])
def test_poor_meshes_give_finite_transfer(method, positions, triangles):
    pytest.importorskip("torch")
    found = bake(TriangleMesh.from_triangles(np.array(positions, float), np.array(triangles)), method)
    assert np.isfinite(found).all()


def test_a_gpu_without_room_hands_over_to_the_processor(monkeypatch, caplog):
    torch = pytest.importorskip("torch")
    mesh = knot()
    expected = bake(mesh, "gnn-paper")
    real, asked = paper_bake._answer, []

    def answer(torch, name, arrays, encoded, edges, device):
        asked.append(device)
        if device == "cuda":
            raise torch.cuda.OutOfMemoryError("no room")
        return real(torch, name, arrays, encoded, edges, device)

    monkeypatch.setattr(paper_bake, "_answer", answer)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)
    np.testing.assert_allclose(bake(mesh, "gnn-paper"), expected, atol=1e-5)
    assert asked == ["cuda", "cpu"] and "too little memory" in caplog.text


def test_the_paper_s_network_sees_some_shadows_and_size_does_not_matter():
    pytest.importorskip("torch")
    mesh = knot()
    truth = methods.run(methods.bake(mesh, "embree", 3, rays=512)).coefficients
    found = bake(mesh, "gnn-paper")
    assert metrics.srr(found, truth, sh.cosine_lobe(mesh.normals, 3)) < 1
    larger = TriangleMesh.from_triangles(mesh.positions * 1e3 + 7, mesh.triangles)
    np.testing.assert_allclose(bake(larger, "gnn-paper"), found, atol=1e-3)


def test_weights_are_small_enough_to_ship():
    assert sum(path.stat().st_size for path in weights.FOLDER.glob("*.safetensors")) < 5e6


@pytest.mark.parametrize("method", PAPERS)
def test_loose_vertices_do_not_matter(method):
    pytest.importorskip("torch")
    mesh = knot()
    loose = TriangleMesh.from_triangles(np.concatenate([mesh.positions, [[50.0, 0, 0]]]), mesh.triangles)
    found = bake(loose, method)
    assert not found[-1].any()
    # the lone vertex takes part in the graph, as a neighbour of the nearest, but not in the size of what is encoded
    np.testing.assert_allclose(np.median(np.abs(found[:-1] - bake(mesh, method))), 0, atol=1e-6)
