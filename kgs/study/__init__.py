"""The study of sparse views: a grid of fits whose finished cells are kept, and its report."""
