"""The light dome: protocol, Modbus driver, model and simulator."""
