"""PNG without a library: reading that checks all and unpacks what is wanted, writing that is made for what a renderer draws."""
