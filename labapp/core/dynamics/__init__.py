"""How the pool changes over a recording: oscillations, modes, spectra, responses to steps."""
