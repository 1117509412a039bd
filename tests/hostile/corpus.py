"""Forged datasets for all known attacks; the marks of a forgery are consistent, see `datasets.py`."""

from tests.hostile.arrays import CHUNKS, LAYOUTS
from tests.hostile.files import FILES
from tests.hostile.manifests import MANIFESTS
from tests.hostile.policies import POLICIES
from tests.hostile.records import ARCHIVES, RECORDS
from tests.hostile.tables import PART_TABLES, PLACES, TASK_TABLES

CORPUS = (
    *(MANIFESTS, TASK_TABLES, PART_TABLES, PLACES, RECORDS),
    *(ARCHIVES, LAYOUTS, CHUNKS, POLICIES, FILES),
)
CASES = [case for cases in CORPUS for case in cases]
