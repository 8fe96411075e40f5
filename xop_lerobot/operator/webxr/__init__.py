"""Any headset whose browser knows WebXR: a page and a WebSocket, served from here."""
