"""What a volume of FDK may be off by beside its noise: see `bias`."""

from flexdt.twin.reconstruction.bias_bound.bias import Bias, bias_of

__all__ = ["Bias", "bias_of"]
