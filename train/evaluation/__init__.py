"""What measures a network: scores on photographs, and a laboratory that renders them."""
