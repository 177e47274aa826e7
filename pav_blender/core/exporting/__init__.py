"""A collection in other tools' files: INSTA's and VHAP's layouts, posed meshes."""

from .insta import export_insta
from .meshes import export_meshes
from .vhap import export_vhap

__all__ = ["export_insta", "export_meshes", "export_vhap"]
