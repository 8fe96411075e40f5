"""WebXR headsets: a page and a WebSocket, served from here."""
