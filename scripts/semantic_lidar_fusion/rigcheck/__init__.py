# SPDX-License-Identifier: MIT
"""Is a rig right? Checks from ordinary driving data, without a target."""
