"""The thesis's experiments on anybody's data: configuration, cells that can be resumed, tables, figures, a report."""
