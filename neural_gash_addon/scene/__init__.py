# SPDX-License-Identifier: GPL-3.0-or-later
"""The only bridge between Blender's data and NumPy arrays. No operators, no panels."""
