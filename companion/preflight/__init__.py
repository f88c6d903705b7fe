"""Is this deployment ready?"""
