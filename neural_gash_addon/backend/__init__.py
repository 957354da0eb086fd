# SPDX-License-Identifier: GPL-3.0-or-later
"""The science: plain arrays in, plain arrays out. Nothing here imports bpy."""
