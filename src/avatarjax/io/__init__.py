"""Files in and out: 3DGS point clouds, images and position maps, videos, weights. Every write is atomic."""
