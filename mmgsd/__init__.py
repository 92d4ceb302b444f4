"""MMGSD: multi-modal Gaussian shape descriptors for correspondence matching of deformable objects."""

__version__ = "0.1.0"
