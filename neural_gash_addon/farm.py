# SPDX-License-Identifier: GPL-3.0-or-later
"""Many bakes on many machines: which are this one's, which are done already, and a line for each.

Every machine works out the same list from the command line alone: no file is opened to know whose turn it is.
"""
from __future__ import annotations

import argparse
import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import bpy

from .backend import exchange
from .backend.errors import UserError
from .cli_bake import choose_meshes, clean_name, finish_bake, prepare_bake
from .cli_files import open_file, sentence
from .ops.job import Job
from .scene.read import same_fingerprint

_OUTPUTS = ("npz", "textures", "png", "out")
_NOT_SETTINGS = {*_OUTPUTS, "command", "inputs", "objects", "frames", "shard", "json"}
_LAST_FRAME = 1_048_574  # of Blender, on both sides of 0


@dataclass(frozen=True)
class Item:
    """One bake."""

    file: str
    object: str | None  # None: the one that is meant, which the open file tells
    frame: int | None   # None: as the file was saved


def frame_list(text: str) -> list[int]:
    """'1-10,20' -> the frames, ascending, each once. Raises ArgumentTypeError."""
    frames: set[int] = set()
    for part in text.split(","):
        match = re.fullmatch(r"\s*(-?\d{1,7})(?:-(-?\d{1,7}))?\s*", part)
        if match is None:
            raise argparse.ArgumentTypeError(f"'{text}' are no frames, such as 1-10 or 1-10,20")
        first = int(match[1])
        last = first if match[2] is None else int(match[2])
        if last < first:
            raise argparse.ArgumentTypeError(f"the frames {first}-{last} end before they begin")
        if max(abs(first), abs(last)) > _LAST_FRAME:
            raise argparse.ArgumentTypeError(f"Blender has no frames beyond {_LAST_FRAME}, on either side of 0")
        frames.update(range(first, last + 1))
    return sorted(frames)


def shard(text: str) -> tuple[int, int]:
    """'2/3' -> (2, 3). Raises ArgumentTypeError."""
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise argparse.ArgumentTypeError(f"'{text}' is no shard; the second of three is 2/3, and the first 1/3")
    return int(match[1]), int(match[2])


def is_wanted(arguments: argparse.Namespace) -> bool:
    """Whether this is a bake of many."""
    return len(arguments.inputs) > 1 or arguments.frames is not None or arguments.shard is not None


def bake_all(arguments: argparse.Namespace, progress: Callable[[float], None] | None) -> Iterator[dict]:
    """Bake this shard's items; of each as it ends: file, object, frame, status, seconds, record or error, warning.

    Args:
        progress: called with the share of an item that is done (0 to 1).
    Raises:
        UserError: before the first, where no item could be kept.
    """
    items = all_items(arguments)
    _check(arguments, items)
    if arguments.shard is not None:
        first, count = arguments.shard
        items = items[first - 1::count]
    for folder in dict.fromkeys(path.parent for item in items for path in _outputs(_of(arguments, item))):
        exchange.check_folder(folder)
    opened = None
    for item in items:
        began = time.perf_counter()
        entry = {"file": item.file, "object": item.object, "frame": item.frame}
        try:
            if opened != item.file:
                opened = None
                open_file(item.file)
            opened = None  # where this fails halfway, the next opens it anew
            found, changed = _bake(arguments, item, entry, progress)
            opened = None if changed else item.file
        except (UserError, OSError) as error:
            found = {"status": "failed", "error": sentence(error)}
        yield {**entry, **found, "seconds": round(time.perf_counter() - began, 3)}


def all_items(arguments: argparse.Namespace) -> list[Item]:
    """Of all shards, in an order that is the same everywhere: by file, object and frame as they were given."""
    return [Item(file, name, frame) for file in dict.fromkeys(arguments.inputs)
            for name in dict.fromkeys(arguments.objects or [None]) for frame in arguments.frames or [None]]


def _check(arguments: argparse.Namespace, items: list[Item]) -> None:
    """UserError where the items could not all be kept."""
    if arguments.share:
        raise UserError("--share bakes objects together, and here each is baked by itself; leave it out.")
    if not _outputs(arguments):
        raise UserError("Nothing of this would be kept; add --npz, --textures, --png or --out.")
    for name in _OUTPUTS:
        pattern = str(getattr(arguments, name) or "")
        if "{frame}" in pattern and arguments.frames is None:
            raise UserError(f"'{pattern}' names a {{frame}}; say which with --frames.")
    written: dict[str, Item] = {}
    for item in items:
        for path in _outputs(_of(arguments, item)):
            other = written.setdefault(os.path.normcase(path), item)
            if other != item:
                what = next(place for place, a, b in (
                    ("{object}", item.object, other.object), ("{frame}", item.frame, other.frame),
                    ("{file}", item.file, other.file)) if a != b)
                hint = (f"put {what} into its name" if what != "{file}" or Path(item.file).stem != Path(other.file).stem
                        else "their names differ only by their folders, so bake them apart")
                raise UserError(f"'{path}' would be written by several bakes; {hint}.")


def _outputs(arguments: argparse.Namespace) -> list[Path]:
    """What is written, files and the folder of textures."""
    return [Path(os.path.abspath(path)) for name in _OUTPUTS if (path := getattr(arguments, name)) is not None]


def _of(arguments: argparse.Namespace, item: Item, name: str | None = None) -> argparse.Namespace:
    """The arguments of one item alone; name: of its object, where the file told it."""
    words = {"{file}": Path(item.file).stem, "{object}": clean_name(name or item.object or "object"),
             "{frame}": "" if item.frame is None else f"{item.frame:04d}"}

    def named(pattern: Path | None) -> Path | None:
        return None if pattern is None else Path(re.sub(r"\{(file|object|frame)\}", lambda m: words[m[0]],
                                                        str(pattern)))

    return argparse.Namespace(**{**vars(arguments), **{key: named(getattr(arguments, key)) for key in _OUTPUTS}})


def _bake(arguments: argparse.Namespace, item: Item, entry: dict, progress: Callable[[float], None] | None,
          ) -> tuple[dict, bool]:
    """Bake an item of the open file unless it is up to date: what to tell, and whether the file must be opened anew.

    Raises:
        UserError, OSError: it cannot be baked or kept.
    """
    if item.frame is None:
        entry["frame"] = bpy.context.scene.frame_current
    else:
        bpy.context.scene.frame_set(item.frame)
    chosen, = choose_meshes(None if item.object is None else [item.object])
    entry["object"] = chosen.name
    own = _of(arguments, item, chosen.name)
    outputs = _outputs(own)
    for path in outputs:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path != own.textures:
            exchange.check_writable(path)
    # What a bake leaves in the file must not be in the next one's outputs; attributes are replaced by the next.
    changes = any((own.out, own.png, own.texture, own.applied_copy))
    objects, batch = prepare_bake(own, [chosen])
    key = _key(own, batch.jobs[0], item)
    state = outputs[0].with_name(outputs[0].name + ".json")
    known = _read_state(state)
    if known is not None and _same(known["key"], key) and all(Path(path).exists() for path in _kept(own, known)):
        return {"status": "up to date", "record": known["record"]}, own.applied_copy
    state.unlink(missing_ok=True)  # were this killed now, nothing may call the old state that of the new files
    outcome, = finish_bake(own, objects, batch, progress)
    assert outcome.record is not None
    record = json.loads(outcome.record.to_json())
    textures = [] if own.textures is None else sorted(path.name for path in own.textures.glob("*.exr"))
    with exchange.atomic(state) as draft:
        draft.write_text(json.dumps({"key": key, "record": record, "textures": textures}, sort_keys=True) + "\n",
                         encoding="utf-8")
    warning = {"warning": outcome.sentence} if outcome.sentence else {}
    return {"status": "baked", "record": record, **warning}, changes


def _kept(own: argparse.Namespace, known: dict) -> list[Path]:
    """What must be there where nothing is to do."""
    if own.textures is None:
        return _outputs(own)
    folder = Path(os.path.abspath(own.textures))  # which is not there where `--texture auto` baked to vertices
    return [path for path in _outputs(own) if path != folder or known["textures"]] + [
        own.textures / name for name in known["textures"]]


def _key(own: argparse.Namespace, job: Job, item: Item) -> dict:
    """What the outputs of an item depend on.

    The numbers of a bake depend on what `Job.key` tells; a .blend and a picture hold the whole scene besides, so for
    them the input must be the same byte for byte.
    """
    digest = ""
    if own.out is not None or own.png is not None:
        with open(item.file, "rb") as file:
            digest = hashlib.file_digest(file, "blake2b").hexdigest()
    settings = {name: value for name, value in vars(own).items() if name not in _NOT_SETTINGS}
    return json.loads(json.dumps({"object": job.name, "file": digest, "settings": settings, **json.loads(job.key)}))


def _same(known: dict, key: dict) -> bool:
    """Whether two keys are of the same bake: the stretch in a fingerprint may differ by rounding."""
    return ({**known, "shape": ""} == {**key, "shape": ""} and isinstance(known.get("shape"), str)
            and same_fingerprint(known["shape"], key["shape"]))


def _read_state(path: Path) -> dict | None:
    """What was baked there; None where nothing was, or what says so is damaged."""
    try:
        known = json.loads(path.read_text(encoding="utf-8"))
        whole = (isinstance(known["key"], dict) and isinstance(known["record"], dict)
                 and all(isinstance(name, str) for name in known["textures"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return known if whole else None
