# SPDX-License-Identifier: GPL-3.0-or-later
"""The radiance decoder: against loops over what it is made of, what holds for any room, and the bake."""
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

torch = pytest.importorskip("torch")

from neural_gash_addon.backend import embedding_bake, weights  # noqa: E402
from neural_gash_addon.backend import irradiance as tracing  # noqa: E402
from neural_gash_addon.backend import spherical_harmonics as sh  # noqa: E402
from neural_gash_addon.backend.errors import UserError  # noqa: E402
from neural_gash_addon.backend.lit_points import lit_points  # noqa: E402
from neural_gash_addon.backend.lit_scene import LitScene  # noqa: E402
from neural_gash_addon.backend.methods import run  # noqa: E402
from neural_gash_addon.backend.networks import embedding as networks  # noqa: E402
from neural_gash_addon.backend.networks.radiance import Radiance  # noqa: E402

from . import test_embedding as base  # noqa: E402

ORDER = 5


@pytest.fixture(scope="module")
def room():
    """Points of a box whose light has a direction; 60 queries: points, normals, direct light."""
    scene = base.box_room()
    points = run(lit_points(scene, scene.occluders(), 210, threads=1, order=ORDER))
    asked = points.places[150:], points.normals[150:], points.direct[150:]
    return replace(points, **{name: value[:150] for name, value in vars(points).items()}), asked


@pytest.fixture(scope="module")
def models():
    return base.network(), decoder()


def decoder(settings=base.TINY):
    """One in which no layer is at zero, as after training."""
    torch.manual_seed(1)
    made = Radiance(settings)
    for parameter in made.parameters():
        torch.nn.init.normal_(parameter, std=0.3)
    return made.eval()


def by_direction(models, points, queries, order=ORDER):
    return run(embedding_bake.Room(models[0], points, models[1]).reflected_from(*queries, order))


def test_scene_points_carry_their_light_by_direction(room):
    points, _ = room
    assert points.shape.shape == (150, 25, 3)
    np.testing.assert_allclose(points.shape[:, 0], points.indirect * sh.normalisation(0, 0), rtol=1e-4, atol=1e-6)
    scene = base.box_room()
    assert run(lit_points(scene, scene.occluders(), 64, threads=1)).shape is None


def test_codes_and_queries_are_as_in_a_loop():
    settings, rng = base.TINY, torch.Generator().manual_seed(0)
    model = decoder()

    def drawn(*size):
        return torch.rand(*size, generator=rng)

    places, normals = drawn(40, 3), torch.nn.functional.normalize(drawn(40, 3) - 0.5, dim=1)
    layout = base.embedding.layout(places.numpy(), settings.halvings, settings.gathered, settings.around)
    frame = networks.Frame.of(places, normals, layout)
    codes = networks.Codes(drawn(2, 10), drawn(2, 10, 16), drawn(2, 10, 16))
    light, shape, lobes = drawn(2, 40), drawn(2, 40, 25), drawn(40, 25)
    found = model.encode(codes, frame, light, shape, lobes)
    kernel = model.pool(frame.lie(frame.gathered)).softmax(1)
    expected = torch.zeros(2, 10, 25)
    for b in range(2):
        for m in range(10):
            share = model.share(codes.value[b, m]).reshape(networks.POOLS, 4).softmax(0)
            for band in range(1, 5):
                much, like = 0, torch.zeros(2 * band + 1)
                for p in range(networks.POOLS):
                    for k, j in enumerate(frame.gathered[m]):
                        weight = share[p, band - 1] * kernel[m, k, p]
                        much += weight * light[b, j]
                        like = like + weight * (shape[b, j] - light[b, j] * lobes[j])[band ** 2:(band + 1) ** 2]
                expected[b, m, band ** 2:(band + 1) ** 2] = like / much
    np.testing.assert_allclose(found.detach(), expected.detach(), rtol=1e-4, atol=1e-5)

    asked, facing = drawn(6, 3), torch.nn.functional.normalize(drawn(6, 3) - 0.5, dim=1)
    direct, known, near = drawn(2, 6), drawn(2, 6), torch.randint(0, 10, (6, 5), generator=rng)
    answer = torch.zeros(2, 6, 25)
    for b in range(2):
        for j in range(6):
            asks, kept = model.asks(torch.stack([direct[b, j], known[b, j]]).log1p()).chunk(2)
            scores, values = [], []
            for k in near[j]:
                lie = networks.relation(asked[j:j + 1], facing[j:j + 1], places[k][None, None], normals[k][None, None],
                                        frame.spacing[k][None, None])
                relates, offset = model.lie(lie)[0, 0].chunk(2)
                score = model.weigh((asks + codes.key[b, k] + relates).relu())
                scores.append(torch.cat([score[:4] + model.kernel(lie)[0, 0], score[4:]]))
                values.append(codes.value[b, k] + offset)
            share = torch.stack(scores).softmax(0)
            gain = (2 * torch.tanh(model.finish(kept + (share[:, 4:] * torch.stack(values)).sum(0)) / 2)).exp()
            answer[b, j] = lobes[j]
            for c in range(1, 25):
                band = int(c ** 0.5)
                answer[b, j, c] += gain[band - 1] * (share[:, band - 1] * expected[b, near[j], c]).sum()
            answer[b, j] *= known[b, j]
    found = model(codes, expected, frame, asked, facing, lobes[:6], direct, known, near)
    np.testing.assert_allclose(found.detach(), answer.detach(), rtol=2e-4, atol=1e-5)


def test_band_0_is_irradiance_and_a_lower_order_the_first_of_the_numbers(room, models):
    points, queries = room
    light, shape = by_direction(models, points, queries)
    assert shape.shape == (60, 25, 3) and shape.dtype == np.float32 and np.isfinite(shape).all()
    np.testing.assert_allclose(shape[:, 0], light * sh.normalisation(0, 0), rtol=1e-5)
    np.testing.assert_array_equal(by_direction(models, points, queries, 3)[1], shape[:, :9])
    np.testing.assert_array_equal(base.reflected(models[0], points, queries), light)
    assert np.abs(shape - light[:, None] * sh.cosine_lobe(queries[1], 5)[:, :, None]).max() > 0.1 * light.mean()


def test_light_is_linear_and_channels_are_apart(room, models):
    points, (places, normals, direct) = room
    _, whole = by_direction(models, points, (places, normals, direct))

    def lit(give):
        changed = base.changed(points, **{name: give(getattr(points, name))
                                          for name in ("emission", "direct", "indirect", "shape")})
        return by_direction(models, changed, (places, normals, give(direct)))[1]

    for factor in (2.0 ** -20, 2.0 ** 20):  # by powers of two nothing is rounded otherwise
        np.testing.assert_array_equal(lit(lambda light, factor=factor: light * np.float32(factor)), whole * factor)
    dark = lit(lambda light: light * np.float32([1, 0, 1]))
    assert not dark[..., 1].any()
    np.testing.assert_allclose(dark[..., ::2], whole[..., ::2], rtol=1e-3, atol=1e-5)
    turned = lit(lambda light: light[..., [1, 2, 0]])
    assert np.abs(turned - whole[..., [1, 2, 0]]).max() > 0  # the albedo stays
    both = base.changed(points, albedo=points.albedo[:, [1, 2, 0]], emission=points.emission[:, [1, 2, 0]],
                        direct=points.direct[:, [1, 2, 0]],
                        indirect=points.indirect[:, [1, 2, 0]], shape=points.shape[..., [1, 2, 0]])
    np.testing.assert_allclose(by_direction(models, both, (places, normals, direct[:, [1, 2, 0]]))[1],
                               whole[..., [1, 2, 0]], rtol=1e-3, atol=1e-5)


def test_a_turned_room_has_turned_light(room):
    models = base.network(networks.Settings(**{**vars(base.TINY), "patch": 64})), decoder()
    points, (places, normals, direct) = room
    _, whole = by_direction(models, points, (places, normals, direct))
    turn = Rotation.random(random_state=1).as_matrix()

    def turned(shape):
        return np.stack([sh.rotate_each(shape[..., c], np.tile(turn, (len(shape), 1, 1))) for c in range(3)], 2)

    moved = base.changed(points, places=points.places @ turn.T + [4, -3, 8], normals=points.normals @ turn.T,
                         shape=turned(points.shape))
    found = by_direction(models, moved, (places @ turn.T + [4, -3, 8], normals @ turn.T, direct))[1]
    np.testing.assert_allclose(found, turned(whole), rtol=2e-2, atol=2e-3 * np.abs(whole).max())


def test_before_training_even_light_is_even_at_any_normal_and_one_light_is_that_light(room):
    points, (places, _, direct) = room
    torch.manual_seed(0)
    models = networks.Embedding(base.TINY).eval(), Radiance(base.TINY).eval()
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    even = base.changed(points, indirect=np.full((150, 3), 2.0),
                        shape=2 * sh.cosine_lobe(points.normals, 5)[:, :, None].repeat(3, 2))
    found = by_direction(models, even, (places, normals, direct))[1]
    np.testing.assert_allclose(found, 2 * sh.cosine_lobe(normals, 5)[:, :, None].repeat(3, 2), rtol=1e-3, atol=1e-4)
    same = rng.normal(size=(25, 3))
    same[0] = 2 * sh.normalisation(0, 0)
    one = base.changed(even, normals=np.tile([0, 0, 1.0], (150, 1)), shape=np.tile(same, (150, 1, 1)))
    found = by_direction(models, one, (places, np.tile([0, 0, 1.0], (60, 1)), direct))[1]
    np.testing.assert_allclose(found, np.tile(same, (60, 1, 1)), rtol=1e-3, atol=1e-3)


def test_every_weight_is_learned_from(room):
    points, (places, normals, direct) = room
    torch.manual_seed(0)
    model, radiance = base.network(), decoder()
    frame = base.frame_of(points)
    light = [torch.from_numpy(each.copy()).T for each in (points.albedo, np.pi * points.emission, points.direct,
                                                          points.indirect)]
    with torch.no_grad():
        codes = model.encoder(frame, *light)
    lobes, asked = (torch.from_numpy(sh.cosine_lobe(each, 5)).float() for each in (points.normals, normals))
    near = torch.from_numpy(base.embedding.nearest_to(places, points.places[:38], 5))
    beyond = radiance.encode(codes, frame, light[3], torch.from_numpy(points.shape.transpose(2, 0, 1).copy()), lobes)
    radiance(codes, beyond, frame, torch.from_numpy(places), torch.from_numpy(normals), asked,
             torch.from_numpy(direct).T, torch.rand(3, 60), near).square().mean().backward()
    for name, parameter in radiance.named_parameters():
        assert parameter.grad is not None and parameter.grad.abs().max() > 1e-8, name


@pytest.mark.parametrize("array", [
    np.ones((1, 18)), np.ones((300, 18)), np.ones((3, 18)), np.eye(18)[:5], np.zeros((40, 18))],
    ids=["one point", "one place", "fewer than k", "few", "black"])
def test_degenerate_rooms_have_numbers(array, models):
    points = base.points_of(array)
    points = replace(points, shape=points.indirect[:, None] * np.ones((1, 25, 1), np.float32))
    light, shape = by_direction(models, points, np.random.default_rng(1).random((3, 9, 3)))
    assert np.isfinite(shape).all() and (shape[:, :, points.indirect.sum(0) == 0] == 0).all()


# --- the bake ---

@pytest.fixture
def shipped(monkeypatch):
    """Networks without training as those that ship."""
    torch.manual_seed(0)
    monkeypatch.setattr(embedding_bake, "network", lambda: networks.Embedding(base.TINY).eval())
    monkeypatch.setattr(embedding_bake, "radiance_network", lambda model: Radiance(model.settings).eval())


def test_a_bake_by_direction_is_like_tracing(shipped):
    scene, rng = base.box_room(), np.random.default_rng(0)
    points = rng.random((200, 3)) * [4, 3, 0] + [0, 0, 1e-9]
    normals = np.tile([0, 0, 1.0], (200, 1))
    normals[7] = 0
    found = run(embedding_bake.irradiance(scene, points, normals, threads=1, order=3))
    assert found.shape.shape == (200, 9, 3) and not found.shape[7].any()
    np.testing.assert_allclose(found.shape[:, 0], found.values * sh.normalisation(0, 0), rtol=1e-4)
    truth = run(tracing.irradiance(scene, points, normals, 2048, threads=1, order=3))
    off = np.square(found.shape - truth.shape).sum() / np.square(truth.shape).sum()
    assert off < 0.2 ** 2
    np.testing.assert_array_equal(
        found.values, run(embedding_bake.irradiance(scene, points, normals, threads=1)).values)


def test_without_room_on_the_gpu_the_processor_does_the_work(shipped, monkeypatch, caplog):
    tried = []

    class Room(embedding_bake.Room):
        def __init__(self, model, points, radiance=None, device="cpu"):
            tried.append(device)
            if device == "cuda":
                raise torch.cuda.OutOfMemoryError("no room")
            super().__init__(model, points, radiance, device)

    monkeypatch.setattr(embedding_bake, "Room", Room)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)
    found = run(embedding_bake.irradiance(base.box_room(), *base.QUERIES, threads=1, order=3))
    assert tried == ["cuda", "cpu"] and "too little memory" in caplog.text and found.values.all()


def test_bad_input_by_direction(shipped):
    scene = base.box_room()
    dark = LitScene(scene.positions, scene.triangles, scene.albedo, np.zeros((14, 3)))
    found = run(embedding_bake.irradiance(dark, *base.QUERIES, order=3))
    assert found.shape.shape == (4, 9, 3) and not found.shape.any() and found.notice == tracing.DARK
    with pytest.raises(UserError, match="finite|number"):
        run(embedding_bake.irradiance(scene, base.QUERIES[0] * np.nan, base.QUERIES[1], order=3))
    with pytest.raises(UserError, match=r"24\.0 m long.*up to 15 m"):
        run(embedding_bake.irradiance(LitScene(scene.positions * 6, scene.triangles, scene.albedo, scene.emission),
                                      *base.QUERIES, order=3))
    with pytest.raises(ValueError, match="order 6"):
        run(embedding_bake.irradiance(scene, *base.QUERIES, order=6))
    room = run(embedding_bake.encoded(scene, threads=1))
    with pytest.raises(ValueError, match="without directions"):
        run(embedding_bake.irradiance(scene, *base.QUERIES, threads=1, room=room, order=3))
    empty = run(embedding_bake.irradiance(scene, np.zeros((0, 3)), np.zeros((0, 3)), threads=1, order=5))
    assert empty.shape.shape == (0, 25, 3)


def test_weights_that_were_saved_are_those_that_are_asked(room, tmp_path, monkeypatch):
    monkeypatch.setattr(weights, "FOLDER", tmp_path)
    model, made = base.network(networks.SMALL), decoder(networks.SMALL)
    with pytest.raises(UserError, match=r"radiance\.safetensors' are missing"):
        embedding_bake.radiance_network(model)
    weights.save(tmp_path / weights.RADIANCE, {name: value.numpy() for name, value in made.state_dict().items()})
    found = by_direction((model, embedding_bake.radiance_network(model).cpu()), *room)[1]
    np.testing.assert_array_equal(found, by_direction((model, made), *room)[1])
