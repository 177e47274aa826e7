"""Avatar files inside a .blend.

The bytes are a property of a text of their own, which heads point to: appending, linking and
saving carry it along, and undo, which copies only what changed, leaves it alone.
"""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

from ..core.errors import InputError
from ..core.files import replacing

_BYTES, _HASH, _NAME = "pav_bytes", "pav_sha256", "pav_name"
_LARGEST = 1 << 30  # Blender holds a property's length in 32 bits


def pack(mesh: Any, path: Path) -> Any:
    """Stores the avatar file at `path` with a head object, in the open .blend; returns the text
    that holds it. InputError where it cannot be read or is too large."""
    import bpy

    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: not readable ({error.strerror})") from error
    if len(data) > _LARGEST:
        raise InputError(f"{path}: {len(data) >> 20} MiB; at most {_LARGEST >> 20} can be packed")
    digest = hashlib.sha256(data).hexdigest()
    text = next((t for t in bpy.data.texts if t.library is None and t.get(_HASH) == digest), None)
    if text is None:
        text = bpy.data.texts.new(path.name)
        text.use_fake_user = False
        text.write(f"The avatar {path.name} is packed with this text ({len(data):,} bytes).\n")
        text[_BYTES], text[_HASH], text[_NAME] = data, digest, path.name
    mesh.pav.pack.text = text
    return text


def unpacked(text: Any) -> Path:
    """The packed file as one on disk, in a folder that Blender removes when it ends.

    InputError where the text holds no avatar, or a damaged one.
    """
    import bpy

    digest, name = str(text.get(_HASH, "")), str(text.get(_NAME, ""))
    if not re.fullmatch("[0-9a-f]{64}", digest) or text.get(_BYTES) is None:
        raise InputError(f"the text {text.name!r} holds no packed avatar; choose the file again")
    folder = Path(bpy.app.tempdir) / "pav" / digest
    # it may be written beside a .blend that came from elsewhere: as an avatar, and nothing else
    stem = re.sub(r"[^\w.-]", "_", Path(name).name).lstrip(".")[:100].removesuffix(".pav")
    path = folder / f"{stem or 'packed'}.pav"
    if path.is_file():  # whole: it was given its name last
        return path
    stored = text[_BYTES]
    # bytes of a number would be as many zeros
    data = stored if isinstance(stored, bytes) else b""
    if hashlib.sha256(data).hexdigest() != digest:
        raise InputError(f"the avatar packed in the text {text.name!r} is damaged")
    with replacing(path) as temporary:
        temporary.write_bytes(data)
    return path


def unpack(mesh: Any) -> Path:
    """Writes a head's packed avatar beside the saved .blend and uses that file from now on; so do
    other heads with the same. Returns it. InputError where another file is in the way."""
    import bpy

    text = mesh.pav.pack.text
    if text is None:
        raise InputError(f"object {mesh.name!r} has no packed avatar")
    if not bpy.data.filepath:
        raise InputError("save the .blend first: the avatar is unpacked beside it")
    source = unpacked(text)
    path = Path(bpy.path.abspath("//")) / source.name
    data = source.read_bytes()
    if path.exists() and path.read_bytes() != data:
        raise InputError(f"{path}: another file is there already; move it away first")
    if not path.exists():
        with replacing(path) as temporary:
            temporary.write_bytes(data)
    for object_ in bpy.data.objects:
        if object_.library is None and object_.pav.pack.text == text:
            object_.pav.avatar = f"//{path.name}"
            object_.pav.pack.text = None
    if text.library is None and text.users == 0:
        bpy.data.texts.remove(text)
    return path
