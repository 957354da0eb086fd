# SPDX-License-Identifier: GPL-3.0-or-later
"""Training data and training of the shipped weights; not part of the extension."""
