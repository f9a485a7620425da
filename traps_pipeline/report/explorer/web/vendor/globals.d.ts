// What the type checker cannot see: the bundle's name, and where pages keep the data that a server put there.
declare const trapsParquet: any;
