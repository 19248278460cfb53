"""The errors of kgs: a wrong argument, a bad file, and a fit whose numbers are no longer finite."""

from ._support.errors import ArgumentError as ArgumentError
from ._support.errors import DataError as DataError
from ._support.errors import PhotosRefused as PhotosRefused
from ._support.errors import TrainingDiverged as TrainingDiverged
