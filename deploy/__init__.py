"""What a team or a cluster starts: servers, workers, scripts for SLURM and Kubernetes. No part of the package."""
