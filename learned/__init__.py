"""Networks that unroll the iteration of `scsr_opt` (paper, Eq. 5) up to SpikeSR-Net (Eq. 6-14)."""
