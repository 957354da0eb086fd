# SPDX-License-Identifier: GPL-3.0-or-later
"""Time to a relative L2 error of 2 %, and time per ray as a whole job."""
from __future__ import annotations

import statistics

from meshes import load
from numpy.typing import NDArray
from peers import Mitsuba, MitsubaArrays, Open3D, Trimesh
from table import Table, interleaved, ratio, seconds

from neural_gash_addon.backend import methods
from neural_gash_addon.backend.geometry import TriangleMesh
from neural_gash_addon.backend.metrics import rel_l2

ORDER, ERROR = 3, 0.02


def measure(table: Table, threads: int, quick: bool) -> None:
    """Print the section on equal error."""
    table.heading(
        "Equal error", f"Seconds from mesh arrays to coefficients (order {ORDER}, building the scene included) to "
        f"rel L2 {ERROR:.0%} against a reference of 4096 rays a point and another seed. Ours: tolerance {ERROR}, "
        "tightened until its true error is no more. Others: the plain estimator, whose error falls exactly as "
        "1/sqrt(rays), measured at two ray counts on the whole mesh and EXTRAPOLATED by that law; 'law' is the "
        "measured error of the smaller count over the larger's, beside what the law says. Mitsuba is measured "
        "twice: its ray_test in the same NumPy program as the others', and all of the job in one compiled "
        "kernel, as an expert would write it.")
    for label in ("8K",) if quick else ("8K", "35K"):
        name, mesh = load(label)
        reference = methods.run(methods.bake(mesh, order=ORDER, rays=4096, seed=99)).coefficients
        _equal_error(table, name, mesh, reference, threads, counts=(64, 256))


def _equal_error(table: Table, name: str, mesh: TriangleMesh, reference: NDArray, threads: int,
                 counts: tuple[int, int]) -> None:
    tolerance = ERROR
    ours = methods.run(methods.bake(mesh, order=ORDER, tolerance=tolerance, threads=threads))
    error = rel_l2(ours.coefficients, reference)
    while error > ERROR:  # equal error is what is measured, not what was asked for
        tolerance *= 0.97 * ERROR / error
        ours = methods.run(methods.bake(mesh, order=ORDER, tolerance=tolerance, threads=threads))
        error = rel_l2(ours.coefficients, reference)

    def bake() -> float:
        return seconds(lambda: methods.run(methods.bake(mesh, order=ORDER, tolerance=tolerance, threads=threads)))

    for peer in (Trimesh, Open3D, MitsubaArrays, Mitsuba):
        try:
            caster = peer(mesh, ORDER)
        except (ImportError, OSError, RuntimeError) as reason:
            table.absent(f"{name}: {peer.name}", reason)
            continue
        caster.transfer(counts[1], 0)  # warm: compiles, touches memory
        build = seconds(lambda p=peer: p(mesh, ORDER))
        errors = [rel_l2(caster.transfer(rays, 1), reference) for rays in counts]
        needed = counts[1] * (errors[1] / ERROR) ** 2
        ours_s, peer_s = interleaved(3, bake, lambda c=caster: seconds(lambda: c.transfer(counts[1], 1)))
        whole = [build + s * needed / counts[1] for s in peer_s]
        table.add(f"{name}: {peer.name}, {needed:.0f} rays (law {errors[0] / errors[1]:.2f}, "
                  f"{(counts[1] / counts[0]) ** 0.5:.2f})",
                  f"{statistics.median(ours_s):.2f} s ({error:.2%}, {ours.record.rays_per_point:.0f} rays)",
                  f"{statistics.median(whole):.1f} s", ratio(whole, ours_s), 100)


def measure_whole_job(table: Table, threads: int, quick: bool) -> None:
    """Print the section on time per ray."""
    table.heading(
        "Per ray, whole job", f"Nanoseconds a ray from mesh arrays to coefficients (order {ORDER}; building the scene, "
        "directions, occlusion, harmonics, sums; ours measures its error besides), beside the same job around "
        "Mitsuba's ray_test: in NumPy, and as one Mitsuba kernel, compiled beforehand. Ratio: theirs over ours.")
    rays = 256
    for label in ("8K",) if quick else ("8K", "35K"):
        name, mesh = load(label)

        def ours(mesh: TriangleMesh = mesh) -> float:
            record = methods.run(methods.bake(mesh, order=ORDER, rays=rays, threads=threads)).record
            return record.seconds / (record.rays + record.probe_rays) * 1e9

        for peer in (MitsubaArrays, Mitsuba):
            def theirs(mesh: TriangleMesh = mesh, peer: type[MitsubaArrays | Mitsuba] = peer) -> float:
                return seconds(lambda: peer(mesh, ORDER).transfer(rays, 1)) / len(mesh.points) / rays * 1e9

            try:
                theirs()  # compiles
            except (ImportError, OSError, RuntimeError) as reason:
                table.absent(f"{name}: {peer.name}", reason)
                continue
            a, b = interleaved(5, ours, theirs)
            table.add(f"{name}, {rays} rays: {peer.name}", f"{statistics.median(a):.0f} ns",
                      f"{statistics.median(b):.0f} ns", ratio(b, a), 1)
