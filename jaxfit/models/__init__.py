"""Model files: saving, loading, and the ones that come with the package."""
