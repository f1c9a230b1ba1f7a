from .cluster import Workers
from .live import LatestPicture, LiveFolder, LiveSequence
from .outputs import SequenceFormat, export
from .plan import Plan
from .run import Written, write_sequence
from .store import SequenceStore

__all__ = [
    "LatestPicture",
    "LiveFolder",
    "LiveSequence",
    "Plan",
    "SequenceFormat",
    "SequenceStore",
    "Workers",
    "Written",
    "export",
    "write_sequence",
]
