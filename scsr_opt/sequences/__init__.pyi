from .cluster import Workers
from .outputs import SequenceFormat, export
from .plan import Plan
from .run import Written, write_sequence
from .store import SequenceStore

__all__ = [
    "Plan",
    "SequenceFormat",
    "SequenceStore",
    "Workers",
    "Written",
    "export",
    "write_sequence",
]
