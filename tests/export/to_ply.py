#!/usr/bin/env python3
"""Reads a map by gaussforge, whose reader of .spz is Niantic's own, and writes it as PLY.

usage: to_ply.py FROM TO
"""

import sys

import gaussforge

source, target = sys.argv[1:]
with open(source, "rb") as file:
    converted = gaussforge.GaussForge().convert(file.read(), source.rsplit(".", 1)[1], "ply", strict=True)
if "error" in converted:
    sys.exit(f"{source}: {converted['error']}")
with open(target, "wb") as file:
    file.write(converted["data"])
