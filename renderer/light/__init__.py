"""Light: bases that an image is linear in, and where coefficients come from."""
