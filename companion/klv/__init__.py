"""Where each picture was taken and what it shows, in the video itself: MISB ST 0601 in MPEG-TS."""
