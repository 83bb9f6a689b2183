"""The paper's four training stages by its letter (`object.recipe: paper`); docs/paper.md says where it cannot be."""
