"""Reports: a diagnosis as one self-contained HTML page."""

from torchcal.report.diagnosis_page import page, write

__all__ = ["page", "write"]
