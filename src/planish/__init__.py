"""planish: registers fringe-projection measurements of feature-poor parts by their surface texture."""

__version__ = "0.1.0"
