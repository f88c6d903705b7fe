"""Camera pose and targets as metadata in the video: MISB ST 0601 in MPEG-TS."""
