# SPDX-License-Identifier: GPL-3.0-or-later
"""The networks of the Neural-GASh paper, in torch, which only these modules import; and the weights that ship."""
