"""Published ADE and FDE of the forecasting tasks: LaM-SLidE, Tables 1 and 4 (arXiv 2502.12128).

All rows but its own are those of GeoTDM (Han et al. 2024, arXiv 2410.13027). 10 frames given, 20 predicted, mean of 5
samples; n-body lengths are dimensionless."""

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

# The same for MD17 (Å; Table 4), by molecule. LaM-SLidE's is one model for all, the others' one a molecule.
PUBLISHED_MD17: dict[str, dict[str, tuple[float, float]]] = {
    "aspirin": {
        "RF": (0.303, 0.442),
        "TFN": (0.133, 0.268),
        "SE(3)-Transformer": (0.294, 0.556),
        "EGNN": (0.267, 0.564),
        "EqMotion": (0.185, 0.246),
        "SVAE": (0.301, 0.428),
        "GeoTDM": (0.107, 0.193),
        "LaM-SLidE": (0.059, 0.098),
    },
    "benzene": {
        "RF": (0.120, 0.194),
        "TFN": (0.024, 0.049),
        "SE(3)-Transformer": (0.027, 0.056),
        "EGNN": (0.024, 0.042),
        "EqMotion": (0.029, 0.043),
        "SVAE": (0.114, 0.133),
        "GeoTDM": (0.023, 0.039),
        "LaM-SLidE": (0.021, 0.032),
    },
    "ethanol": {
        "RF": (0.374, 0.515),
        "TFN": (0.201, 0.414),
        "SE(3)-Transformer": (0.188, 0.359),
        "EGNN": (0.268, 0.401),
        "EqMotion": (0.152, 0.247),
        "SVAE": (0.387, 0.505),
        "GeoTDM": (0.115, 0.209),
        "LaM-SLidE": (0.087, 0.167),
    },
    "malonaldehyde": {
        "RF": (0.297, 0.454),
        "TFN": (0.184, 0.386),
        "SE(3)-Transformer": (0.214, 0.456),
        "EGNN": (0.393, 0.958),
        "EqMotion": (0.155, 0.249),
        "SVAE": (0.287, 0.430),
        "GeoTDM": (0.107, 0.176),
        "LaM-SLidE": (0.073, 0.124),
    },
    "naphthalene": {
        "RF": (0.168, 0.185),
        "TFN": (0.072, 0.098),
        "SE(3)-Transformer": (0.069, 0.103),
        "EGNN": (0.095, 0.133),
        "EqMotion": (0.073, 0.092),
        "SVAE": (0.124, 0.135),
        "GeoTDM": (0.064, 0.087),
        "LaM-SLidE": (0.037, 0.058),
    },
    "salicylic-acid": {
        "RF": (0.261, 0.343),
        "TFN": (0.115, 0.223),
        "SE(3)-Transformer": (0.189, 0.312),
        "EGNN": (0.159, 0.348),
        "EqMotion": (0.110, 0.151),
        "SVAE": (0.122, 0.142),
        "GeoTDM": (0.083, 0.120),
        "LaM-SLidE": (0.047, 0.074),
    },
    "toluene": {
        "RF": (0.199, 0.249),
        "TFN": (0.090, 0.150),
        "SE(3)-Transformer": (0.108, 0.184),
        "EGNN": (0.207, 0.294),
        "EqMotion": (0.097, 0.129),
        "SVAE": (0.145, 0.171),
        "GeoTDM": (0.083, 0.121),
        "LaM-SLidE": (0.045, 0.075),
    },
    "uracil": {
        "RF": (0.239, 0.272),
        "TFN": (0.090, 0.159),
        "SE(3)-Transformer": (0.107, 0.196),
        "EGNN": (0.154, 0.282),
        "EqMotion": (0.088, 0.116),
        "SVAE": (0.145, 0.156),
        "GeoTDM": (0.074, 0.099),
        "LaM-SLidE": (0.050, 0.074),
    },
}
