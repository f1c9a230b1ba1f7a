"""Networks that unroll the iteration of Eq. 5, up to SpikeSR-Net (Eq. 6-14), and their parts."""
