"""The cascade of linear regressors: its parameters, fitting and training."""
