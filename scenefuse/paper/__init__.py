"""The paper by its letter: four training stages, registration, published numbers and the comparison with them."""
