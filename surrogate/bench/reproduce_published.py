"""Published ADE and FDE of the n-body tasks: LaM-SLidE, Table 1 (arXiv 2502.12128); all rows but its own are those of
GeoTDM (Han et al. 2024, arXiv 2410.13027). 10 frames given, 20 predicted, mean of 5 samples, dimensionless lengths."""

from __future__ import annotations

# Task: method: (ADE, FDE).
PUBLISHED: dict[str, dict[str, tuple[float, float]]] = {
    "n-body-charged": {
        "RF": (0.479, 1.050),
        "TFN": (0.330, 0.754),
        "SE(3)-Transformer": (0.395, 0.936),
        "EGNN": (0.186, 0.426),
        "EqMotion": (0.141, 0.310),
        "SVAE": (0.378, 0.732),
        "GeoTDM": (0.110, 0.258),
        "LaM-SLidE": (0.104, 0.238),
    },
    "n-body-spring": {
        "RF": (0.0145, 0.0389),
        "TFN": (0.1013, 0.2364),
        "SE(3)-Transformer": (0.0865, 0.2043),
        "EGNN": (0.0101, 0.0231),
        "EqMotion": (0.0134, 0.0358),
        "SVAE": (0.0120, 0.0209),
        "GeoTDM": (0.0030, 0.0079),
        "LaM-SLidE": (0.0070, 0.0135),
    },
    "n-body-gravity": {
        "RF": (0.791, 1.630),
        "TFN": (0.327, 0.761),
        "SE(3)-Transformer": (0.338, 0.830),
        "EGNN": (0.310, 0.709),
        "EqMotion": (0.302, 0.671),
        "SVAE": (0.582, 1.101),
        "GeoTDM": (0.256, 0.613),
        "LaM-SLidE": (0.157, 0.406),
    },
}
