"""Which rods a slice may show."""

from typing import Final

# A rod that leaves the slice at less than 11.5 degrees (sine 0.2) has a streak for a spot: neither sought nor counted.
LEAST_COSINE: Final = 0.2
# How far beyond its end a rod may be cut: the noise apart, partial volume makes its end unsharp.
END_SLACK_MM: Final = 1.0
# A rod is surely cut only so far from its ends.
SURE_MM: Final = 2.0
