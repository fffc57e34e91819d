"""What came of a solve: replays, the certificate, and the files that hold them."""
