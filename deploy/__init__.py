"""Programs for a team or a cluster: servers, workers, scripts for SLURM and Kubernetes. Not part of the package."""
