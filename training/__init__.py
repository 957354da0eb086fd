# SPDX-License-Identifier: GPL-3.0-or-later
"""Data and training of the shipped weights; not part of the extension."""
