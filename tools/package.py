# SPDX-License-Identifier: GPL-3.0-or-later
"""Build the extension's zips, one for each platform, with Blender's own tool: `make package`."""
from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SOURCE = ROOT / "neural_gash_addon"
WHEELS = SOURCE / "wheels"  # where the manifest wants them; not in the repository
PYTHONS = ("3.11", "3.13")  # of Blender 4.5 and 5.0, and of 5.2
PLATFORMS = {"linux-x64": "manylinux_2_28_x86_64 manylinux_2_17_x86_64", "windows-x64": "win_amd64",
             "macos-arm64": "macosx_14_0_arm64"}


def download_wheels() -> None:
    """Fetch what the manifest lists and is not here yet; pip checks every file against tools/wheels.txt."""
    wanted = {Path(w).name for w in tomllib.loads((SOURCE / "blender_manifest.toml").read_text())["wheels"]}
    WHEELS.mkdir(exist_ok=True)
    if not wanted <= {w.name for w in WHEELS.glob("*.whl")}:
        for python in PYTHONS:
            for names in PLATFORMS.values():
                platforms = [a for name in names.split() for a in ("--platform", name)]
                subprocess.run([sys.executable, "-m", "pip", "download", "--disable-pip-version-check", "-q",
                                "--only-binary=:all:", "--no-deps", "--require-hashes", "-r",
                                str(ROOT / "tools" / "wheels.txt"), "--python-version", python,
                                "--implementation", "cp", "-d", str(WHEELS), *platforms], check=True)
    for wheel in WHEELS.glob("*.whl"):
        if wheel.name not in wanted:
            wheel.unlink()
    missing = wanted - {w.name for w in WHEELS.glob("*.whl")}
    if missing:
        sys.exit(f"These wheels could not be had: {', '.join(sorted(missing))}")


def blender_tool(*arguments: str) -> None:
    """Run Blender's extension builder, which comes with the bpy module."""
    import bpy
    tool = Path(bpy.utils.system_resource("SCRIPTS")) / "addons_core" / "bl_pkg" / "cli" / "blender_ext.py"
    subprocess.run([sys.executable, str(tool), *arguments], check=True)


def main() -> None:
    """Download, validate, build."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=ROOT / "dist")
    output = parser.parse_args().output
    download_wheels()
    for cache in SOURCE.rglob("__pycache__"):
        shutil.rmtree(cache)
    import bpy
    tags = Path(bpy.utils.system_resource("SCRIPTS")) / "modules" / "_bpy_internal" / "extensions" / "tags.py"
    blender_tool("validate", f"--valid-tags={tags}", str(SOURCE))
    output.mkdir(parents=True, exist_ok=True)
    blender_tool("build", "--split-platforms", "--source-dir", str(SOURCE), "--output-dir", str(output))


if __name__ == "__main__":
    main()
