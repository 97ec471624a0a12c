"""What a workshop needs to mount a rig: a drawing to scale, a table, and housings and frustums in space."""
