"""The product's judgement on real imagery: acceptance, covariance, protection level, search."""
