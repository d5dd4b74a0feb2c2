"""The misfit: whether what a fit leaves is noise, and where it sits if it is not."""
