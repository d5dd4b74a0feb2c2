"""Real recordings whose missing physics is known, for `torchcal.diagnose` to find, or to say that it cannot."""
