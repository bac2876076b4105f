"""What happens where a great many renders, views, faces, photographs or runs are asked for."""
