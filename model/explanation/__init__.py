"""Explanations of forecasts by Shapley values: own state, map and neighbours, and each neighbour."""
