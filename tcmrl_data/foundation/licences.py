"""Licences by their SPDX identifiers, and expressions of them."""

import difflib
import re

_NAMES = """
0BSD AGPL-3.0-only AGPL-3.0-or-later Apache-2.0 Artistic-2.0 BSD-2-Clause BSD-3-Clause BSD-3-Clause-Clear
BSL-1.0 CC-BY-3.0 CC-BY-4.0 CC-BY-NC-4.0 CC-BY-NC-ND-4.0 CC-BY-NC-SA-4.0 CC-BY-ND-4.0 CC-BY-SA-3.0
CC-BY-SA-4.0 CC0-1.0 CDLA-Permissive-1.0 CDLA-Permissive-2.0 CDLA-Sharing-1.0 CECILL-2.1 ECL-2.0 EPL-2.0
EUPL-1.2 GPL-2.0-only GPL-2.0-or-later GPL-3.0-only GPL-3.0-or-later ISC LGPL-2.1-only LGPL-2.1-or-later
LGPL-3.0-only LGPL-3.0-or-later MIT MIT-0 MPL-2.0 NCSA O-UDA-1.0 ODC-By-1.0 ODbL-1.0 PDDL-1.0 Python-2.0
Unlicense Zlib
"""

LICENCES = frozenset(_NAMES.split())
"""Identifiers of the SPDX licence list (https://spdx.org/licenses) that data and research code use."""

OWN = re.compile(r"LicenseRef-[A-Za-z0-9.-]{1,100}")
"""SPDX's form for a licence that its list does not have."""

AND = " AND "


def licence_problem(text: str) -> str | None:
    """Why a text is no licence, in words for an error message; None if it is one.

    A licence is an SPDX identifier, a `LicenseRef-NAME`, or several of them joined by `AND` or `OR`.
    """
    for name in re.split(r" AND | OR ", text):
        if name in LICENCES or OWN.fullmatch(name):
            continue
        spelled = {licence.lower(): licence for licence in LICENCES}
        near = [spelled[one] for one in difflib.get_close_matches(name.lower(), spelled, n=3, cutoff=0.5)]
        meant = f"did you mean {', '.join(near)}? " if near else ""
        return f"{name[:80]!r} is no SPDX licence; {meant}One of your own is written LicenseRef-NAME"
    return None


def joined_licences(licences: list[str]) -> str:
    """The licence of something that is under all the given ones, each named once, in order."""
    return AND.join(sorted({name for licence in licences for name in licence.split(AND)}))
