# SPDX-License-Identifier: GPL-3.0-or-later
"""The zip that is shipped: built by Blender's own tool, installed into an empty user folder, used, disabled."""
import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
BPY_52 = "5.2.3"


@pytest.fixture(scope="module")
def dist(tmp_path_factory):
    output = tmp_path_factory.mktemp("dist")
    done = subprocess.run([sys.executable, "tools/package.py", "--output", str(output)], cwd=ROOT,
                          capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return output


def install(python: str, zip_path: Path, folder: Path, modules: Path | None = None) -> None:
    """Run install_session.py with `folder` as the user's; Python sees only `modules` where it is given."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    folder.mkdir()
    environment["BLENDER_USER_RESOURCES"] = str(folder)
    options = []
    if modules is not None:
        environment["PYTHONPATH"] = str(modules)
        options = ["-S"]
    done = subprocess.run([python, *options, str(ROOT / "tests" / "ship" / "install_session.py"), str(zip_path)],
                          env=environment, cwd=folder, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0 and "installed, baked, disabled" in done.stdout, done.stdout + done.stderr
    assert "Traceback" not in done.stderr, done.stderr


def test_one_zip_for_each_platform_holds_its_wheels_and_nothing_strange(dist):
    zips = sorted(dist.glob("*.zip"))
    assert [z.stem.split("-")[-1] for z in zips] == ["linux_x64", "macos_arm64", "windows_x64"]
    for path, mark in zip(zips, ("manylinux", "macosx", "win_amd64"), strict=True):
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        wheels = [n for n in names if n.endswith(".whl")]
        assert len(wheels) == 4 and all(mark in w for w in wheels)
        assert manifest["license"] == ["SPDX:GPL-3.0-or-later"]
        assert not [n for n in names if n.endswith((".pyc", ".blend"))]
        assert "cli.py" in names


def test_versions_agree():
    from neural_gash_addon.backend.record import VERSION
    manifest = tomllib.loads((ROOT / "neural_gash_addon" / "blender_manifest.toml").read_text())
    assert manifest["version"] == VERSION


def test_zip_installs_bakes_and_leaves_nothing(dist, tmp_path):
    modules = tmp_path / "modules"  # bpy and what it imports; the embreex of this environment would hide the zip's
    modules.mkdir()
    for name in ("bpy", "numpy", "numpy.libs", "requests", "urllib3", "idna", "certifi", "charset_normalizer",
                 "zstandard"):
        folder = Path(sysconfig.get_path("purelib")) / name
        if folder.exists():
            (modules / name).symlink_to(folder)
    install(sys.executable, next(dist.glob("*linux*")), tmp_path / "user", modules)


def _python_313() -> str | None:
    candidates = [shutil.which("python3.13"),
                  *sorted(Path.home().glob(".pyenv/versions/3.13*/bin/python3.13"), reverse=True)]
    for candidate in filter(None, candidates):
        if subprocess.run([str(candidate), "-c", ""], capture_output=True).returncode == 0:
            return str(candidate)
    return None


def test_zip_works_on_blender_52_with_its_own_wheels(dist, tmp_path):
    base = _python_313()
    if base is None:
        pytest.skip("needs a Python 3.13, which Blender 5.2 runs on; none was found")
    python = ROOT / ".venv52" / "bin" / "python"
    if subprocess.run([str(python), "-c", f"import importlib.metadata as m; assert m.version('bpy') == '{BPY_52}'"],
                      capture_output=True).returncode if python.exists() else True:
        subprocess.run([base, "-m", "venv", "--clear", str(ROOT / ".venv52")], check=True)
        done = subprocess.run([str(python), "-m", "pip", "install", "-q", "--disable-pip-version-check",
                               f"bpy=={BPY_52}"], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    install(str(python), next(dist.glob("*linux*")), tmp_path / "user")
