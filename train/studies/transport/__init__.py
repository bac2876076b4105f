"""What shadows and bounces cost, how right they are, and what becomes of adversaries that are found without them."""
