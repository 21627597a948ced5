"""Human video with annotated or detected hands: sources whose episodes are cut out of long recordings."""
