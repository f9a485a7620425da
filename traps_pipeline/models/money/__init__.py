"""Forecast what calls cost, reserve it, and cap spending."""
