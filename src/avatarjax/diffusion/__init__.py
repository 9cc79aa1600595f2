"""Diffusion as pure functions: DDPM schedules, objectives, DDIM and EDM samplers as `lax.scan`."""
