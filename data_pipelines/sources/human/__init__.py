"""Human video with annotated or detected hands: sources whose episodes are segments of long recordings."""
