# SPDX-License-Identifier: GPL-3.0-or-later
"""The one exception that is meant to be read by a person."""


class UserError(ValueError):
    """Something about the input that a person can mend; its message is one clear sentence."""
